"""A lit target before a black sky: threshold, outline at the local half maximum, stars and hot pixels left out.

Parts too dim for single pixels are found by :mod:`hat_ros.segmentation.dim`. Parts as black as the sky cannot be seen
and are not in the mask, unless a trusted silhouette says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hat_ros.array_types import Bool, Float32, UInt8
from hat_ros.segmentation.masks import Mask, fill_holes, touches_border

# A sky pixel is at most this bright (8-bit, any channel); black level and noise of real cameras stay below. In an image
# exposed so that nothing is bright, ground is as dark: there this share of the brightest pixel, but not less than that.
SKY_MAX = 48
_SKY_MAX_SHARE, _SKY_MAX_LEAST = 0.15, 12
_SKY_MAX_CHROMA = 16  # between its brightest channel and its darkest: a dark sea is blue
_RING_PX = 8  # width of the image border that is looked at for the sky
_NOISE_SIGMAS = 5.0
_MIN_STEP = 1.5  # smallest excess over the sky that counts, for noise-free images
# Measured from the outline's neighbourhood: a pixel less than half covered is darker than this share of the local
# maximum. Below one half because the maximum, not the mean, of the neighbourhood is the reference.
_EDGE_SHARE = 0.4
_STAR_AREA_PX = 40  # a blob below this, away from the target, is a star
_SPECK_AREA_PX = 6
_HOLE_SHARE = 0.1  # a hole up to this share of the area is a dark detail; larger ones are gaps between parts
# Gaps bridged, and room left around the lit parts, as shares of their longer side.
_BRIDGED_SHARES = (0.02, 0.04, 0.08, 0.16)
_BRIDGED_MARGIN = 0.1
_FAINT_STEPS = 4  # below this many thresholds of contrast a single pixel tells nothing
_MAX_REGIONS = 8  # looked at; a field of stars may hold thousands
_ROOM_PX = 2  # around a region: what its outline is trimmed with reaches so far
_HOT_EXCESS = 30  # a hot pixel is this much brighter than all its neighbours

Box = tuple[slice, slice]

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

    luma: UInt8
    mean3: Float32
    level: float
    threshold: float
    border_share: float


def measure_sky(rgb: UInt8) -> Sky:
    """Level and noise of the sky from the image border: (H, W, 3) uint8."""
    luma = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    around = cv2.dilate(luma, _NEIGHBOURS)
    hot = cv2.threshold(cv2.subtract(luma, around), _HOT_EXCESS, 1, cv2.THRESH_BINARY)[1]
    cv2.copyTo(around, hot, luma)
    mean3 = np.asarray(cv2.boxFilter(luma, cv2.CV_32F, (3, 3)), np.float32)
    ring = np.concatenate([mean3[strip].ravel() for strip in _border(luma.shape)])
    dark = ring[_dark_border(rgb)]
    if dark.size < 8:
        return Sky(luma, mean3, 0.0, 0.0, 0.0)
    level, sigma = level_and_noise(dark)
    threshold = level + max(_NOISE_SIGMAS * sigma, _MIN_STEP)
    return Sky(luma, mean3, level, threshold, float(np.count_nonzero(dark <= threshold)) / ring.size)


def level_and_noise(values: Float32) -> tuple[float, float]:
    """Median of (n,) values and their standard deviation about it, without those that lie far off."""
    level = _median(values)
    return level, 1.4826 * _median(np.abs(values - level))


def _median(values: Float32) -> float:
    """``np.median`` without most of its overhead."""
    half = len(values) // 2
    low = half - 1 + len(values) % 2
    return float(np.partition(values, (low, half))[low : half + 1].mean())


def dark_border_share(rgb: UInt8) -> float:
    """Share of the image border that is dark enough to be sky, quickly: never less than ``Sky.border_share``."""
    dark = _dark_border(rgb)
    return np.count_nonzero(dark) / max(1, len(dark))


def _dark_border(rgb: UInt8) -> Bool:
    """Which pixels of the border are black in every channel, and have no colour."""
    red, green, blue = np.concatenate([rgb[strip].reshape(-1, 3) for strip in _border(rgb.shape)]).T
    brightest = np.maximum(np.maximum(red, green), blue)
    limit = np.clip(_SKY_MAX_SHARE * rgb.max(), _SKY_MAX_LEAST, SKY_MAX)
    return (brightest < limit) & (brightest - np.minimum(np.minimum(red, green), blue) < _SKY_MAX_CHROMA)


def _border(shape: tuple[int, ...]) -> tuple[tuple[slice, slice], ...]:
    """Every other row and column of the image border: neighbours share pixels of their means anyway."""
    r = min(_RING_PX, min(shape[:2]) // 4)
    return np.s_[1:r:2, ::2], np.s_[-r:-1:2, ::2], np.s_[r:-r:2, 1:r:2], np.s_[r:-r:2, -r:-1:2]


def lit_regions(sky: Sky) -> list[UInt8]:
    """Bright objects, largest first, each (H, W) uint8 of 0 and 1: connected pieces and what lies close to them."""
    bright = (sky.mean3 > sky.threshold).astype(np.uint8)
    gap = max(2, round(0.006 * max(bright.shape)))
    x, y, w, h = cv2.boundingRect(bright)
    if not w:
        return []
    # All further work is done in the part of the image that holds anything.
    x0, y0 = max(0, x - gap - 2), max(0, y - gap - 2)
    x1, y1 = min(bright.shape[1], x + w + gap + 2), min(bright.shape[0], y + h + gap + 2)
    luma = np.ascontiguousarray(sky.luma[y0:y1, x0:x1])
    peak = np.asarray(cv2.dilate(luma, _K5), np.uint8)
    out = []
    for box, piece in _groups(np.ascontiguousarray(bright[y0:y1, x0:x1]), gap):
        region = np.zeros_like(bright)
        region[y0:y1, x0:x1][box] = _trim_outline(piece, luma[box], peak[box], sky)
        out.append(region)
    return out


def _groups(bright: Mask, gap: int) -> list[tuple[Box, Mask]]:
    """Pieces of one body are close together: 0/1 masks of what is joined when small gaps are, largest first.

    Each in a box of its own with some room around it, where the image has it.
    """
    # OpenCV's own statistics take several times as long as its labels; what follows is done for bright pixels only.
    _, label = cv2.connectedComponents(bright, connectivity=8)
    at = np.flatnonzero(bright)
    piece = label.ravel()[at]
    at = at[np.bincount(piece)[piece] >= _SPECK_AREA_PX]
    bright = np.zeros_like(bright)
    bright.ravel()[at] = 1
    joined = cv2.dilate(bright, cv2.getStructuringElement(cv2.MORPH_RECT, (2 * gap + 1, 2 * gap + 1)))
    _, label = cv2.connectedComponents(joined, connectivity=8)
    group = label.ravel()[at]
    area = np.bincount(group)
    order = [g for g in np.argsort(-area, kind="stable") if area[g] >= _STAR_AREA_PX]
    y, x = np.divmod(at, bright.shape[1])
    out = []
    for g in order[:_MAX_REGIONS]:
        own = group == g
        rows, cols = y[own], x[own]
        top, left = max(0, rows.min() - _ROOM_PX), max(0, cols.min() - _ROOM_PX)
        box = np.s_[top : rows.max() + _ROOM_PX + 1, left : cols.max() + _ROOM_PX + 1]
        region = np.zeros_like(bright[box])
        region[rows - top, cols - left] = 1
        out.append((box, region))
    return out


def _trim_outline(region: Mask, luma: UInt8, peak: UInt8, sky: Sky) -> Mask:
    """Take off what blur and the 3 x 3 mean added around the outline; ``peak`` is the brightest pixel near each."""
    region = fill_holes(region, _HOLE_SHARE)
    inner = np.asarray(cv2.erode(region, _K5, borderType=cv2.BORDER_REPLICATE), np.uint8)
    at = region != inner
    high = peak[at] - sky.level
    # Where the step is within the noise of a single pixel the mean decides, which already chose the region.
    faint = high < _FAINT_STEPS * (sky.threshold - sky.level)
    inner[at] = (luma[at] - sky.level >= _EDGE_SHARE * high) | faint
    return inner


def join_parts(regions: list[UInt8], main: int) -> UInt8:
    """The main region with the others that lie within half its size of it: parts cut off by shadow.

    What the image border cuts is not joined to what it does not cut: that may be a planet.
    """
    out = regions[main].copy()
    x, y, w, h = cv2.boundingRect(out)
    margin = 0.5 * max(w, h)
    for index, region in enumerate(regions):
        if index == main or (touches_border(region) and not touches_border(regions[main])):
            continue
        u, v, a, b = cv2.boundingRect(region)
        near_x = u >= x - margin and u + a <= x + w + margin
        if near_x and v >= y - margin and v + b <= y + h + margin:
            out |= region
    return out


def lit_share(lit: UInt8) -> float:
    """How much of a body is lit, 0 to 1: share of an (H, W) 0/1 mask in what it covers with its gaps joined."""
    x, y, w, h = cv2.boundingRect(lit)
    scale = min(1.0, 64 / max(w, h))
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    share = cv2.resize(lit[y : y + h, x : x + w] * 255, size, interpolation=cv2.INTER_AREA)
    joined = cv2.morphologyEx(share, cv2.MORPH_CLOSE, np.ones((11, 11), np.uint8))
    return float(share.mean()) / float(joined.mean())


def bridge_gaps(lit: UInt8, side_px: int) -> tuple[tuple[slice, slice], list[Bool]]:
    """What a body of which only scattered parts are lit may look like: gaps of growing width bridged.

    Args:
        lit: (H, W) uint8 of 0 and 1, the lit parts.
        side_px: longer side of the reduced masks returned.

    Returns:
        The part of the image that holds the lit parts, and reduced (h, w) masks of it; the first has no gap bridged.
    """
    x, y, w, h = cv2.boundingRect(lit)
    margin = round(_BRIDGED_MARGIN * max(w, h)) + 1
    box = np.s_[max(0, y - margin) : y + h + margin, max(0, x - margin) : x + w + margin]
    part = lit[box] * 255
    scale = min(1.0, side_px / max(part.shape))
    size = (max(1, round(part.shape[1] * scale)), max(1, round(part.shape[0] * scale)))
    share = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
    small = (share > 63).astype(np.uint8)
    out = [share > 127]
    for gap in _BRIDGED_SHARES:
        radius = max(1, round(gap * max(w, h) * scale))
        padded = cv2.copyMakeBorder(small, radius, radius, radius, radius, cv2.BORDER_CONSTANT, value=0)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[radius:-radius, radius:-radius]
        out.append(fill_holes(np.ascontiguousarray(closed), 1.0).astype(bool))
    return box, out
