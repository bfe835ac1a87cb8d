"""The mask as a signed distance, and the areas in which a rendered view agrees with it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from hat_ros.array_types import Bool, Float, Float32, UInt8
from hat_ros.refinement.view import View
from hat_ros.target.masks import mask_moments

# Luma from which a pixel is certainly not a shadowed part of the target, which is black.
VISIBLE_LEVEL = 32.0
# The field reaches this far around the mask, pixels and share of the mask's longer side.
_MIN_MARGIN_PX = 20
_MARGIN_SHARE = 0.15
# Histogram of how deep inside the mask its pixels lie.
_DEPTH_BIN_PX = 0.05
_DEPTH_BINS = 200


class MaskField:
    """A mask as a signed distance, on the crop that matters.

    Args:
        mask: (H, W) bool with at least one pixel set.
    """

    def __init__(self, mask: Bool) -> None:
        self.mask = mask
        pixels = mask.view(np.uint8)
        left, top, width, height = cv2.boundingRect(pixels)
        self.area_px = float(cv2.countNonZero(pixels))
        self.size_px = float(max(width, height))
        margin = int(max(_MIN_MARGIN_PX, _MARGIN_SHARE * self.size_px))
        # Beyond the image border nothing is known: the border pixels continue, so that a cut is no contour.
        y0, y1 = max(top - margin, -margin), min(top + height + margin, mask.shape[0] + margin)
        x0, x1 = max(left - margin, -margin), min(left + width + margin, mask.shape[1] + margin)
        self.origin_px = np.array([x0, y0], dtype=np.float64)
        inside = pixels[max(y0, 0) : y1, max(x0, 0) : x1]
        beyond = (max(-y0, 0), max(y1 - mask.shape[0], 0), max(-x0, 0), max(x1 - mask.shape[1], 0))
        crop = np.asarray(cv2.copyMakeBorder(inside, *beyond, cv2.BORDER_REPLICATE), np.uint8)
        self._beyond = beyond
        distance = _distance_to_zero(1 - crop)
        # Inwards where the mask is; with two pixels around it nothing outside can be nearer.
        left, top, width, height = cv2.boundingRect(crop)
        box = np.s_[max(0, top - 2) : top + height + 2, max(0, left - 2) : left + width + 2]
        distance[box] -= _distance_to_zero(crop[box]) if not crop.all() else np.float32(1e3 + 0.5)
        # A boundary lies half a pixel from the centres on either side of it.
        distance += crop
        distance -= np.float32(0.5)
        self.distance = np.asarray(cv2.GaussianBlur(distance, (0, 0), 1.0), np.float32)

    @cached_property
    def centroid_px(self) -> Float:
        """(2,) centre of gravity."""
        return mask_moments(self.mask).center_px

    @cached_property
    def _depth_counts(self) -> NDArray[np.intp]:
        """Histogram of how deep inside the mask its pixels lie, those of the image only."""
        top, bottom, left, right = self._beyond
        height, width = self.distance.shape
        seen = self.distance[top : height - bottom, left : width - right]
        depth = -seen[seen < 0]
        bins = np.minimum(depth * (1 / _DEPTH_BIN_PX), _DEPTH_BINS - 1).astype(np.intp)
        return np.bincount(bins, minlength=_DEPTH_BINS)

    def compare(self, view: View, luma: UInt8, tolerance_px: float | None = None) -> Overlap:
        """Areas of agreement and disagreement with a rendered silhouette.

        Args:
            view: the silhouette.
            luma: (H, W) the image in grey.
            tolerance_px: only what lies deeper than this on the wrong side of the mask's outline counts as
                disagreement, in part over one pixel of depth; None counts every pixel.
        """
        depth, band = (0.0, 1e-3) if tolerance_px is None else (tolerance_px, 1.0)
        total = self.area_px if tolerance_px is None else self._area_deeper_than(tolerance_px)
        offset = view.origin_px - self.origin_px
        where = (self.distance, offset, luma, view.origin_px, 1.0 / view.scale, depth, band)
        common, missing, hidden = silhouette_areas(view.mask, *where)
        if view.lit is not None:  # nothing is missed in the shadow
            _, missing, hidden = silhouette_areas(view.lit, *where)
        return Overlap(common, max(total - common, 0.0), missing, hidden)

    def _area_deeper_than(self, depth_px: float) -> float:
        centers = (np.arange(_DEPTH_BINS) + 0.5) * _DEPTH_BIN_PX
        return float(self._depth_counts @ np.clip(centers - depth_px, 0.0, 1.0))


def _distance_to_zero(pixels: UInt8) -> Float32:
    """Distance (H, W) of each pixel to the nearest one that is zero."""
    return np.asarray(cv2.distanceTransform(pixels, cv2.DIST_L2, 5), np.float32)


@njit(cache=True, nogil=True)
def silhouette_areas(
    silhouette: Bool,
    distance: Float32,
    offset: Float,
    luma: UInt8,
    origin: Float,
    step: float,
    depth: float,
    band: float,
) -> tuple[float, float, float]:
    """Image pixels of a silhouette that lie inside a mask, outside it before something bright, and before black.

    Args:
        silhouette: (h, w) crop.
        distance: signed distance to the mask's outline, positive outside, on the mask's own crop.
        offset: (2,) position of the silhouette's pixel (0, 0) on that crop.
        luma: (H, W) image.
        origin: (2,) position of the silhouette's pixel (0, 0) in the image.
        step: image pixels per crop pixel.
        depth: distance from the outline from which a pixel counts, fully from ``depth + band`` on.
        band: see there.
    """
    h, w = distance.shape
    height, width = luma.shape
    common, missing, hidden = 0.0, 0.0, 0.0
    for y in range(silhouette.shape[0]):
        v = origin[1] + y * step
        if v < -0.5 or v > height - 0.5:
            continue
        b = offset[1] + y * step
        for x in range(silhouette.shape[1]):
            if not silhouette[y, x]:
                continue
            u = origin[0] + x * step
            if u < -0.5 or u > width - 0.5:
                continue
            a = offset[0] + x * step
            if a < 0.0 or b < 0.0 or a >= w - 1 or b >= h - 1:
                d = 1e3  # beyond the field, so far from the mask
            else:
                ia, ib = int(a), int(b)
                fa, fb = a - ia, b - ib
                d = (distance[ib, ia] * (1 - fa) + distance[ib, ia + 1] * fa) * (1 - fb) + (
                    distance[ib + 1, ia] * (1 - fa) + distance[ib + 1, ia + 1] * fa
                ) * fb
            if d < 0.0:
                common += min(max((-d - depth) / band, 0.0), 1.0)
            else:
                share = min(max((d - depth) / band, 0.0), 1.0)
                level = luma[min(max(int(v + 0.5), 0), height - 1), min(max(int(u + 0.5), 0), width - 1)]
                visible = min(level / VISIBLE_LEVEL, 1.0)
                missing += share * visible
                hidden += share * (1.0 - visible)
    area = step * step
    return common * area, missing * area, hidden * area


@dataclass(frozen=True)
class Overlap:
    """Areas in pixels of the image, inside the image only.

    Attributes:
        common: mask and silhouette.
        extra: mask without silhouette.
        missing: silhouette without mask, before something bright.
        hidden: silhouette without mask, before black: it may be there, unlit.
    """

    common: float
    extra: float
    missing: float
    hidden: float

    @property
    def union_share(self) -> float:
        """Intersection over union."""
        return self.common / max(self.common + self.extra + self.missing + self.hidden, 1e-9)

    @property
    def visible_share(self) -> float:
        """Intersection over union, of what could be seen."""
        return self.common / max(self.common + self.extra + self.missing, 1e-9)
