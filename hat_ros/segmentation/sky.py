"""A lit target before a black sky: threshold, outline at the local half maximum, stars and hot pixels left out.

Parts that are as black as the sky cannot be seen and are not in the mask, unless a trusted silhouette says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

# A sky pixel is at most this bright (8-bit luma); black level and noise of real cameras stay below.
_SKY_MAX = 40
_RING_PX = 8  # width of the image border that is looked at for the sky
_NOISE_SIGMAS = 5.0
_MIN_STEP = 1.5  # smallest excess over the sky that counts, for noise-free images
# Measured from the outline's neighbourhood: a pixel less than half covered is darker than this share of the local
# maximum. Below one half because the maximum, not the mean, of the neighbourhood is the reference.
_EDGE_SHARE = 0.4
_STAR_AREA_PX = 40  # a blob below this, away from the target, is a star
_SPECK_AREA_PX = 6
_HOLE_SHARE = 0.1  # a hole up to this share of the area is a dark detail; larger ones are gaps between parts
_COARSE_PX = 9  # side of the mean that finds what is barely brighter than the sky
_HOT_EXCESS = 30  # a hot pixel is this much brighter than all its neighbours

_K3 = np.ones((3, 3), np.uint8)
_K5 = np.ones((5, 5), np.uint8)
_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)


@dataclass(frozen=True)
class Sky:
    """Brightness of the sky in one image.

    Attributes:
        luma: (H, W) uint8 image without hot pixels.
        mean3: (H, W) float32 mean of 3 x 3 pixels of it.
        level: its median on the sky.
        threshold: what lies above in ``mean3`` is not sky.
        border_share: share of the image border that is sky, 0 when there is none.
    """

    luma: NDArray[np.uint8]
    mean3: NDArray[np.float32]
    level: float
    threshold: float
    border_share: float


def measure_sky(rgb: NDArray[np.uint8]) -> Sky:
    """Level and noise of the sky from the image border: (H, W, 3) uint8."""
    luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    around = cv2.dilate(luma, _NEIGHBOURS)
    luma = np.where(luma > cv2.add(around, _HOT_EXCESS), around, luma)
    mean3 = cv2.boxFilter(luma, cv2.CV_32F, (3, 3))
    r = min(_RING_PX, min(luma.shape) // 4)
    ring = np.concatenate(
        [mean3[1:r].ravel(), mean3[-r:-1].ravel(), mean3[r:-r, 1:r].ravel(), mean3[r:-r, -r:-1].ravel()]
    )
    dark = ring[ring < _SKY_MAX]
    if not dark.size:
        return Sky(luma, mean3, 0.0, 0.0, 0.0)
    level = float(np.median(dark))
    sigma = 1.4826 * float(np.median(np.abs(dark - level)))
    threshold = level + max(_NOISE_SIGMAS * sigma, _MIN_STEP)
    return Sky(luma, mean3, level, threshold, float(np.count_nonzero(ring <= threshold)) / ring.size)


def lit_regions(sky: Sky) -> list[NDArray[np.uint8]]:
    """Bright objects, largest first, each (H, W) uint8 of 0 and 1: connected pieces and what lies close to them."""
    bright = (sky.mean3 > sky.threshold).astype(np.uint8)
    _, label, stats, _ = cv2.connectedComponentsWithStats(bright, connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    keep = area >= _SPECK_AREA_PX
    if not keep.any():
        return []
    bright = keep.astype(np.uint8)[label]
    # Pieces of one body are close together: join what a small gap separates.
    gap = max(2, round(0.006 * max(bright.shape)))
    joined = cv2.dilate(bright, cv2.getStructuringElement(cv2.MORPH_RECT, (2 * gap + 1, 2 * gap + 1)))
    n_groups, group = cv2.connectedComponents(joined, connectivity=8)
    group_area = np.bincount(group.ravel(), weights=bright.ravel(), minlength=n_groups)
    group_area[0] = 0
    order = [g for g in np.argsort(-group_area, kind="stable") if group_area[g] >= _STAR_AREA_PX]
    return [trim_outline(sky, ((group == g) & (bright > 0)).astype(np.uint8)) for g in order[:8]]


def trim_outline(sky: Sky, region: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Take off what blur and the 3 x 3 mean added around the outline."""
    region = fill_holes(region, _HOLE_SHARE)
    inner = cv2.erode(region, _K5, borderType=cv2.BORDER_REPLICATE)
    peak = cv2.dilate(sky.luma, _K5).astype(np.float32)
    inside = sky.luma - sky.level >= _EDGE_SHARE * (peak - sky.level)
    # Where the step is within the noise of a single pixel the mean decides, which already chose the region.
    faint = peak - sky.level < 4 * (sky.threshold - sky.level)
    return region & (inner | inside | faint)


def fill_holes(mask: NDArray[np.uint8], max_share: float) -> NDArray[np.uint8]:
    """Fill enclosed holes smaller than a share of the mask's area: dark details, not gaps between parts."""
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if hierarchy is None or (hierarchy[0, :, 3] < 0).all():
        return mask
    out = mask.copy()
    limit = max_share * np.count_nonzero(mask)
    for contour, node in zip(contours, hierarchy[0], strict=True):
        if node[3] >= 0 and cv2.contourArea(contour) <= limit:
            cv2.drawContours(out, [contour], -1, 1, -1)
    return out


def join_parts(regions: list[NDArray[np.uint8]], main: int) -> NDArray[np.uint8]:
    """The main region with the others that lie within half its size of it: parts cut off by shadow."""
    out = regions[main].copy()
    x, y, w, h = cv2.boundingRect(out)
    margin = 0.5 * max(w, h)
    for index, region in enumerate(regions):
        if index == main:
            continue
        u, v, a, b = cv2.boundingRect(region)
        near_x = u >= x - margin and u + a <= x + w + margin
        if near_x and v >= y - margin and v + b <= y + h + margin:
            out |= region
    return out


def bridge_gaps(measured: Sky, lit: NDArray[np.uint8], side_px: int) -> list[NDArray[np.bool_]]:
    """What a body of which only scattered parts are lit may look like: gaps of growing width bridged.

    Args:
        measured: the sky of this image.
        lit: (H, W) uint8 of 0 and 1, the lit parts.
        side_px: longer side of the reduced masks returned.

    Returns:
        Reduced (h, w) masks; the first has no gap bridged.
    """
    coarse = cv2.boxFilter(measured.luma, cv2.CV_32F, (_COARSE_PX, _COARSE_PX))
    # A mean over n x n instead of 3 x 3 pixels has 3 / n of the noise.
    faint = coarse > measured.level + (measured.threshold - measured.level) * 3 / _COARSE_PX
    faint = cv2.erode(faint.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_RECT, (_COARSE_PX, _COARSE_PX)))
    x, y, w, h = cv2.boundingRect(lit)
    near = np.zeros_like(lit)
    near[y : y + h, x : x + w] = faint[y : y + h, x : x + w]
    scale = min(1.0, side_px / max(lit.shape))
    size = (max(1, round(lit.shape[1] * scale)), max(1, round(lit.shape[0] * scale)))
    small_lit = (cv2.resize(lit * 255, size, interpolation=cv2.INTER_AREA) > 127).astype(np.uint8)
    small = (cv2.resize((lit | near) * 255, size, interpolation=cv2.INTER_AREA) > 63).astype(np.uint8)
    out = [small_lit.astype(bool)]
    for share in (0.02, 0.04, 0.08, 0.16):
        radius = max(1, round(share * max(w, h) * scale))
        padded = cv2.copyMakeBorder(small, radius, radius, radius, radius, cv2.BORDER_CONSTANT, value=0)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[radius:-radius, radius:-radius]
        out.append(fill_holes(np.ascontiguousarray(closed), 1.0).astype(bool))
    return out


def touches_border(mask: NDArray[np.uint8]) -> bool:
    """Whether an (H, W) mask reaches the image border."""
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())
