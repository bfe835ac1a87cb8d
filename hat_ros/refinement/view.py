"""What the image should show at a pose, and what the detection says: the two sides that refinement compares."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
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
from hat_ros.render.embree import RayCaster
from hat_ros.target import Target
from hat_ros.types import Camera

# Luma at which background is bright enough to tell that no target covers it; a shadowed part is black.
VISIBLE_LEVEL = 32.0
# Margin of the rendered crop around the target, in crop pixels: the contour needs background on both sides.
_CROP_MARGIN_PX = 4
# Signed distance reported beyond the field of a mask.
_FAR_OUTSIDE_PX = 1e3
# Histogram of how deep inside the mask its pixels lie.
_DEPTH_BIN_PX = 0.05
_DEPTH_BINS = 200


@dataclass(frozen=True, eq=False)
class View:
    """The silhouette on a crop that holds the whole target, at its own resolution.

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

    def resample(self, image: NDArray[np.generic]) -> NDArray[np.generic]:
        """An image seen through this crop; 0 beyond its border."""
        affine = np.array([[1 / self.scale, 0, self.origin_px[0]], [0, 1 / self.scale, self.origin_px[1]]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(image, affine, (self.camera.width, self.camera.height), flags=flags)

    def inside(self, image_shape: tuple[int, int]) -> NDArray[np.bool_] | None:
        """(h, w) which crop pixels lie in an image of this (height, width); None when all do."""
        height, width = image_shape
        x = np.arange(self.camera.width) / self.scale + self.origin_px[0]
        y = np.arange(self.camera.height) / self.scale + self.origin_px[1]
        if x[0] >= -0.5 and y[0] >= -0.5 and x[-1] <= width - 0.5 and y[-1] <= height - 0.5:
            return None
        return ((y >= -0.5) & (y <= height - 0.5))[:, None] & ((x >= -0.5) & (x <= width - 0.5))[None]


class TargetViewer:
    """Casts silhouettes of one target for refinement and scoring: every second pixel, then all near the outline."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self._caster = RayCaster(target)
        try:
            self._hull_m = target.vertices_m[ConvexHull(target.vertices_m).vertices]
        except QhullError:  # a flat model
            self._hull_m = target.vertices_m

    def view(self, T_cam_target: NDArray[np.float64], camera: Camera, side_px: int) -> View | None:
        """The target at a pose, its longer side ``side_px`` crop pixels; None when it reaches behind the camera."""
        points = self._hull_m @ T_cam_target[:3, :3].T + T_cam_target[:3, 3]
        if not np.isfinite(points).all() or points[:, 2].min() <= 1e-3 * self.target.bounding_radius_m:
            return None
        uv = camera.project(points)
        low, high = uv.min(axis=0), uv.max(axis=0)
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
        to_ray = (R.T @ np.linalg.inv(crop.K)).T  # rays in the target frame are affine in the pixel
        origin = -t @ R
        ys, xs = np.mgrid[0 : crop.height : 2, 0 : crop.width : 2]
        hit, z = self._trace(xs.ravel(), ys.ravel(), to_ray, origin)
        coarse = hit.reshape(xs.shape).view(np.uint8)
        kernel = np.ones((3, 3), np.uint8)
        near = cv2.dilate(coarse, kernel) != cv2.erode(coarse, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        mask = np.repeat(np.repeat(coarse.view(np.bool_), 2, axis=0), 2, axis=1)
        depth = np.zeros(mask.shape, np.float32)
        depth[::2, ::2] = z.reshape(xs.shape)
        todo = np.repeat(np.repeat(near, 2, axis=0), 2, axis=1)
        todo[::2, ::2] = False
        y, x = np.nonzero(todo)
        if len(x):
            hit, z = self._trace(x, y, to_ray, origin)
            mask[y, x] = hit
            depth[y, x] = z
        return mask, depth

    def _trace(
        self, x: NDArray[np.intp], y: NDArray[np.intp], to_ray: NDArray[np.float64], origin: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """Hit (N,) and depth (N,) of the rays through crop pixels."""
        directions = np.empty((len(x), 3), np.float32)
        for axis in range(3):
            directions[:, axis] = x * to_ray[0, axis] + y * to_ray[1, axis] + to_ray[2, axis]
        origins = np.empty_like(directions)
        origins[:] = origin
        hits = self._caster.trace(origins, directions)
        return hits["primID"] >= 0, hits["tfar"]


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
        self.area_px = float(np.count_nonzero(mask))
        rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        self.size_px = float(max(np.ptp(rows), np.ptp(cols)) + 1)
        margin = int(max(24, 0.35 * self.size_px))
        # Beyond the image border nothing is known: the border pixels continue, so that a cut is no contour.
        height, width = mask.shape
        y0, y1 = max(rows[0] - margin, -margin), min(rows[-1] + 1 + margin, height + margin)
        x0, x1 = max(cols[0] - margin, -margin), min(cols[-1] + 1 + margin, width + margin)
        self.origin_px = np.array([x0, y0], dtype=np.float64)
        iy = np.clip(np.arange(y0, y1), 0, height - 1)
        ix = np.clip(np.arange(x0, x1), 0, width - 1)
        crop = mask[np.ix_(iy, ix)].astype(np.uint8)
        # A boundary lies half a pixel from the centres on either side of it.
        outside = cv2.distanceTransform(1 - crop, cv2.DIST_L2, 5) - 0.5
        inside = cv2.distanceTransform(crop, cv2.DIST_L2, 5) - 0.5 if not crop.all() else np.full_like(outside, 1e3)
        distance = np.where(crop > 0, -inside, outside).astype(np.float32)
        self.distance = cv2.GaussianBlur(distance, (0, 0), 1.0)
        within = ((iy == np.arange(y0, y1))[:, None]) & ((ix == np.arange(x0, x1))[None])
        depth = -self.distance[within & (self.distance < 0)]
        self._depth_counts = np.bincount(
            np.minimum(depth * (1 / _DEPTH_BIN_PX), _DEPTH_BINS - 1).astype(np.intp), minlength=_DEPTH_BINS
        )

    def resample(self, view: View) -> NDArray[np.float32]:
        """Signed distance in image pixels, seen through a view's crop; far outside beyond the field."""
        affine = np.array(
            [
                [1 / view.scale, 0, view.origin_px[0] - self.origin_px[0]],
                [0, 1 / view.scale, view.origin_px[1] - self.origin_px[1]],
            ]
        )
        size = (view.camera.width, view.camera.height)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(self.distance, affine, size, flags=flags, borderValue=_FAR_OUTSIDE_PX)

    def area_deeper_than(self, depth_px: float) -> float:
        """Mask pixels further than this from the outline; counted in part over one pixel of depth."""
        centers = (np.arange(_DEPTH_BINS) + 0.5) * _DEPTH_BIN_PX
        return float(self._depth_counts @ np.clip(centers - depth_px, 0.0, 1.0))

    def compare(self, view: View, luma: NDArray[np.uint8]) -> Overlap:
        """Areas of agreement and disagreement with a rendered silhouette; ``luma`` is the (H, W) image."""
        seen = self.resample(view)
        silhouette = view.mask
        inside = view.inside(self.mask.shape)
        if inside is not None:
            silhouette = silhouette & inside
        unit = 1.0 / view.scale**2
        common = float(np.count_nonzero(silhouette & (seen < 0))) * unit
        beside = view.resample(luma)[silhouette & (seen >= 0)]
        visible = float(np.minimum(beside * (1.0 / VISIBLE_LEVEL), 1.0).sum()) * unit
        return Overlap(common, max(self.area_px - common, 0.0), visible, len(beside) * unit - visible)


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
