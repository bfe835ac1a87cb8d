"""What the image should show at a pose, and what the detection says: the two sides that refinement compares."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from hat_ros.refinement.contour import (
    COL_INSIDE,
    COL_NU,
    COL_NV,
    COL_OUTSIDE,
    COL_WEIGHT,
    contour_table,
)
from hat_ros.refinement.outline import grid_rays, pixel_rays, place_pixels, spread_grid
from hat_ros.render.embree import RayCaster
from hat_ros.target import Target
from hat_ros.types import Camera

# Luma at which background is bright enough to tell that no target covers it; a shadowed part is black.
VISIBLE_LEVEL = 32.0
# Margin of the rendered crop around the target, in crop pixels: the contour needs background on both sides.
_CROP_MARGIN_PX = 4
# What lies further outside the image than this share of its longer side is not rendered.
_BEYOND_IMAGE = 0.05
# The field reaches this far around the mask, pixels and share of the mask's longer side.
_MIN_MARGIN_PX = 20
_MARGIN_SHARE = 0.15
# Histogram of how deep inside the mask its pixels lie.
_DEPTH_BIN_PX = 0.05
_DEPTH_BINS = 200


@dataclass(frozen=True, eq=False)
class View:
    """The silhouette on a crop that holds what the image can show of the target, at its own resolution.

    Attributes:
        mask: (h, w) bool silhouette.
        depth_m: (h, w) float32 depth along the optical axis near the outline; unspecified elsewhere.
        camera: intrinsics of the crop.
        origin_px: (2,) image position of the crop's pixel (0, 0).
        scale: crop pixels per image pixel.
    """

    mask: NDArray[np.bool_]
    depth_m: NDArray[np.float32]
    camera: Camera
    origin_px: NDArray[np.float64]
    scale: float


class TargetViewer:
    """Casts silhouettes of one target for refinement and scoring, most rays near the outline."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self._caster = RayCaster(target)
        try:
            self._hull_m = target.vertices_m[ConvexHull(target.vertices_m).vertices]
        except QhullError:  # a flat model
            self._hull_m = target.vertices_m

    def view(self, T_cam_target: NDArray[np.float64], camera: Camera, side_px: int) -> View | None:
        """The target at a pose, longer side ``side_px`` crop pixels; None when out of view or behind the camera."""
        points = self._hull_m @ T_cam_target[:3, :3].T + T_cam_target[:3, 3]
        if not np.isfinite(points).all() or points[:, 2].min() <= 1e-3 * self.target.bounding_radius_m:
            return None
        uv = camera.project(points)
        size = np.array([camera.width, camera.height])
        beyond = _BEYOND_IMAGE * size.max()
        low = np.clip(uv.min(axis=0), -beyond, size + beyond)
        high = np.clip(uv.max(axis=0), -beyond, size + beyond)
        scale = (side_px - 2 * _CROP_MARGIN_PX) / max(float((high - low).max()), 1e-3)
        if not 1e-3 < scale < 1e3:
            return None
        origin = low - _CROP_MARGIN_PX / scale
        width, height = np.ceil((high - origin) * scale).astype(int) + _CROP_MARGIN_PX
        K = camera.K.copy()
        K[:2, 2] -= origin
        K[:2] *= scale
        crop = Camera(K, int(width + width % 2), int(height + height % 2))
        mask, depth = self._cast(T_cam_target, crop)
        return View(mask, depth, crop, origin, scale)

    def _cast(self, T_cam_target: NDArray[np.float64], crop: Camera) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """Silhouette and depth near its outline, both (h, w)."""
        R, t = T_cam_target[:3, :3], T_cam_target[:3, 3]
        to_ray = np.ascontiguousarray((R.T @ np.linalg.inv(crop.K)).T)  # rays in the target frame: affine in the pixel
        origin = -t @ R
        hits = self._caster.trace(*grid_rays(crop.width, crop.height, to_ray, origin))
        mask, depth, x, y = spread_grid(hits["primID"], hits["tfar"], crop.width, crop.height)
        if len(x):
            hits = self._caster.trace(*pixel_rays(x, y, to_ray, origin))
            place_pixels(mask, depth, x, y, hits["primID"], hits["tfar"])
        return mask, depth


@dataclass(frozen=True, eq=False)
class ContourLines:
    """The contour of a view as the solver wants it.

    Attributes:
        points_m: (N, 3) in the target frame.
        lines: (N, 5) outward normal (2), contour length it stands for, free distance inwards and outwards; pixels of
            the image.
    """

    points_m: NDArray[np.float64]
    lines: NDArray[np.float64]


def contour_lines(view: View, T_cam_target: NDArray[np.float64], max_points: int) -> ContourLines:
    """Sample the contour of a view."""
    table = contour_table(view.depth_m, view.mask, view.camera.K, max_points)
    points = (table[:, :3] - T_cam_target[:3, 3]) @ T_cam_target[:3, :3]
    lines = table[:, [COL_NU, COL_NV, COL_WEIGHT, COL_INSIDE, COL_OUTSIDE]]
    lines[:, 2:] /= view.scale
    return ContourLines(points, lines)


class MaskField:
    """A mask as a signed distance, on the crop that matters.

    Args:
        mask: (H, W) bool with at least one pixel set.
    """

    def __init__(self, mask: NDArray[np.bool_]) -> None:
        self.mask = mask
        pixels = mask.view(np.uint8)
        left, top, width, height = cv2.boundingRect(pixels)
        moments = cv2.moments(pixels[top : top + height, left : left + width], binaryImage=True)
        self.area_px = moments["m00"]
        self.size_px = float(max(width, height))
        self.centroid_px = np.array([left + moments["m10"] / self.area_px, top + moments["m01"] / self.area_px])
        margin = int(max(_MIN_MARGIN_PX, _MARGIN_SHARE * self.size_px))
        # Beyond the image border nothing is known: the border pixels continue, so that a cut is no contour.
        y0, y1 = max(top - margin, -margin), min(top + height + margin, mask.shape[0] + margin)
        x0, x1 = max(left - margin, -margin), min(left + width + margin, mask.shape[1] + margin)
        self.origin_px = np.array([x0, y0], dtype=np.float64)
        inside = pixels[max(y0, 0) : y1, max(x0, 0) : x1]
        beyond = (max(-y0, 0), max(y1 - mask.shape[0], 0), max(-x0, 0), max(x1 - mask.shape[1], 0))
        crop = cv2.copyMakeBorder(inside, *beyond, cv2.BORDER_REPLICATE)
        self._beyond = beyond
        outward = cv2.distanceTransform(1 - crop, cv2.DIST_L2, 5)
        inward = cv2.distanceTransform(crop, cv2.DIST_L2, 5) if not crop.all() else np.full_like(outward, 1e3 + 0.5)
        # One of the two is zero. A boundary lies half a pixel from the centres on either side of it.
        distance = outward - inward
        distance += crop
        distance -= np.float32(0.5)
        self.distance = cv2.GaussianBlur(distance, (0, 0), 1.0)

    @cached_property
    def _depth_counts(self) -> NDArray[np.intp]:
        """Histogram of how deep inside the mask its pixels lie, those of the image only."""
        top, bottom, left, right = self._beyond
        height, width = self.distance.shape
        seen = self.distance[top : height - bottom, left : width - right]
        depth = -seen[seen < 0]
        bins = np.minimum(depth * (1 / _DEPTH_BIN_PX), _DEPTH_BINS - 1).astype(np.intp)
        return np.bincount(bins, minlength=_DEPTH_BINS)

    def compare(self, view: View, luma: NDArray[np.uint8], tolerance_px: float | None = None) -> Overlap:
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
        common, missing, hidden = silhouette_areas(
            view.mask, self.distance, offset, luma, view.origin_px, 1.0 / view.scale, depth, band
        )
        return Overlap(common, max(total - common, 0.0), missing, hidden)

    def _area_deeper_than(self, depth_px: float) -> float:
        centers = (np.arange(_DEPTH_BINS) + 0.5) * _DEPTH_BIN_PX
        return float(self._depth_counts @ np.clip(centers - depth_px, 0.0, 1.0))


@njit(cache=True, nogil=True)
def silhouette_areas(
    silhouette: NDArray[np.bool_],
    distance: NDArray[np.float32],
    offset: NDArray[np.float64],
    luma: NDArray[np.uint8],
    origin: NDArray[np.float64],
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
