"""What the image should show at a pose: silhouette, contour and what of it the sun shines on."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import Bool, Float, Float32, UInt8
from hat_ros.geometry import lie
from hat_ros.refinement.hits import facing, hit_points, image_box, normals_towards
from hat_ros.target.contour import (
    COL_INSIDE,
    COL_NU,
    COL_NV,
    COL_OUTSIDE,
    COL_U,
    COL_V,
    COL_WEIGHT,
    contour_table,
)
from hat_ros.target.model import Target
from hat_ros.target.rays import Hits, ray_caster
from hat_ros.target.silhouette import Rays, SeenSilhouette, cast_silhouette
from hat_ros.types import Camera

# Margin of the rendered crop around the target, in crop pixels: the contour needs background on both sides.
_CROP_MARGIN_PX = 4
_ROUNDING_PX = 1e-6
# What lies further outside the image than this share of its longer side is not rendered.
_BEYOND_IMAGE = 0.05
# Shadow rays start this far off the surface, in bounding radii; light this close to grazing counts as none.
_SHADOW_START = 2e-3
_GRAZING = 0.02


@dataclass(frozen=True, eq=False)
class View:
    """The silhouette on a crop that holds what the image can show of the target, at its own resolution.

    Attributes:
        mask: (h, w) bool silhouette.
        depth_m: (h, w) float32 depth along the optical axis near the outline; unspecified elsewhere.
        camera: intrinsics of the crop.
        origin_px: (2,) image position of the crop's pixel (0, 0).
        scale: crop pixels per image pixel.
        T_cam_target: (4, 4) pose that it shows.
        seen: the rays that found it and what they hit, in the target frame.
        lit: (h, w) bool part of the silhouette that the sun shines on; None when no sun is known.
    """

    mask: Bool
    depth_m: Float32
    camera: Camera
    origin_px: Float
    scale: float
    T_cam_target: Float
    seen: SeenSilhouette
    lit: Bool | None = None

    def shifted(self, shift_px: Float) -> View:
        """The same silhouette (2,) image pixels further."""
        return replace(self, origin_px=self.origin_px + shift_px)


@dataclass(frozen=True, eq=False)
class Surfels:
    """Points of the surface that rays see, in the target frame.

    Attributes:
        pixel: (M,) index of the ray that sees each.
        points_m: (M, 3) position.
        normals: (M, 3) unit, towards the camera.
        rgb: (M, 3) uint8 albedo, sRGB.
    """

    pixel: NDArray[np.intp]
    points_m: Float32
    normals: Float32
    rgb: UInt8


class TargetViewer:
    """Casts silhouettes of one target for refinement and scoring, most rays near the outline."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self._caster = ray_caster(target)
        self._normals = target.face_normals.astype(np.float32)
        self._shadow_start_m = _SHADOW_START * target.bounding_radius_m

    def made_up(self, side_px: int) -> tuple[Camera, Float]:
        """Square camera and a (4, 4) pose at which it sees the whole target, for the warm-up."""
        camera = Camera(np.array([[side_px, 0, side_px / 2], [0, side_px, side_px / 2], [0, 0, 1.0]]), side_px, side_px)
        center_m = np.array([0.0, 0.0, 4.0 * self.target.bounding_radius_m])
        return camera, lie.transform(np.eye(3), center_m - self.target.center_m)

    def view(
        self,
        T_cam_target: Float,
        camera: Camera,
        side_px: int,
        to_sun_cam: Float | None = None,
    ) -> View | None:
        """The target at a pose, longer side ``side_px`` crop pixels; None when out of view or behind the camera.

        With a direction to the sun, (3,) in the camera frame, the view also tells what the sun shines on.
        """
        bounds = self.bounds(T_cam_target, camera)
        if bounds is None:
            return None
        beyond = _BEYOND_IMAGE * max(camera.width, camera.height)
        x0, x1 = (min(max(x, -beyond), camera.width + beyond) for x in (bounds[0], bounds[2]))
        y0, y1 = (min(max(y, -beyond), camera.height + beyond) for y in (bounds[1], bounds[3]))
        scale = float((side_px - 2 * _CROP_MARGIN_PX) / max(x1 - x0, y1 - y0, 1e-3))
        if not 1e-3 < scale < 1e3:
            return None
        origin = np.array([x0, y0]) - _CROP_MARGIN_PX / scale
        # The longer side is a whole number up to rounding, which must not decide.
        width = math.ceil((x1 - origin[0]) * scale - _ROUNDING_PX) + _CROP_MARGIN_PX
        height = math.ceil((y1 - origin[1]) * scale - _ROUNDING_PX) + _CROP_MARGIN_PX
        K = camera.K.copy()
        K[:2, 2] -= origin
        K[:2] *= scale
        crop = Camera(K, width + width % 2, height + height % 2)
        R, t = T_cam_target[:3, :3], T_cam_target[:3, 3]
        to_ray = np.ascontiguousarray((R.T @ np.linalg.inv(crop.K)).T)  # rays in the target frame: affine in the pixel
        seen = cast_silhouette(self._caster, crop.width, crop.height, to_ray, -t @ R)
        view = View(seen.mask, seen.depth_m, crop, origin, scale, T_cam_target, seen)
        return view if to_sun_cam is None else self.in_sunlight(view, to_sun_cam)

    def in_sunlight(self, view: View, to_sun_cam: Float) -> View:
        """The same view, and what of it a sun shines on: direction (3,) to it in the camera frame, any length."""
        seen = view.seen
        to_sun = (to_sun_cam / np.linalg.norm(to_sun_cam) @ view.T_cam_target[:3, :3]).astype(np.float32)
        sunlit = self._sunlit_hits(*seen.grid, to_sun).reshape(view.mask.shape[0] // 2, view.mask.shape[1] // 2)
        lit = np.repeat(np.repeat(sunlit, 2, axis=0), 2, axis=1)
        lit[seen.y, seen.x] = self._sunlit_hits(*seen.scattered, to_sun)
        return replace(view, lit=lit)

    def bounds(self, T_cam_target: Float, camera: Camera) -> Float | None:
        """Image box (x0, y0, x1, y1) around the target, None when it is not in front of the camera."""
        R, t = np.ascontiguousarray(T_cam_target[:3, :3]), np.ascontiguousarray(T_cam_target[:3, 3])
        return image_box(self.target.hull_m, R, t, camera.K, 1e-3 * self.target.bounding_radius_m)

    def surface(self, directions: Float, origin_m: Float) -> Surfels:
        """What rays (N, 3) from one point see, in the target frame."""
        rays = directions.astype(np.float32)
        origins = np.empty_like(rays)
        origins[:] = origin_m
        return self._surfels((origins, rays), self._caster.trace(origins, rays))

    def surfels(self, view: View, rays: NDArray[np.intp]) -> Surfels:
        """What some of a view's grid of rays see: (N,) which, row by row of every second pixel of the crop."""
        (origins, directions), hits = view.seen.grid
        return self._surfels((origins[rays], directions[rays]), hits.taken(rays))

    def _surfels(self, rays: Rays, hits: Hits) -> Surfels:
        origins, directions = rays
        at, points = hit_points(origins, directions, hits.face, hits.distance)
        hit = hits.taken(at)
        rgb = self.target.surface.sample(hit.face, hit.barycentric, self.target.face_rgb)
        return Surfels(at, points, normals_towards(directions[at], hit.face, self._normals), rgb)

    def _sunlit_hits(self, rays: Rays, hits: Hits, to_sun: Float32) -> Bool:
        """Which of the rays (N,) hit something that the sun shines on."""
        origins, directions = rays
        at, points = hit_points(origins, directions, hits.face, hits.distance)
        normals = normals_towards(directions[at], hits.face[at], self._normals)
        lit = np.zeros(len(directions), np.bool_)
        lit[at] = self.sunlit(points, normals, to_sun) > 0
        return lit

    def sunlit(self, points_m: Float32, normals: Float32, to_sun: Float32) -> Float32:
        """Cosine of the sun's incidence (N,) at points that the camera sees, 0 where the sun does not reach.

        Args:
            points_m: (N, 3) on the surface.
            normals: (N, 3) unit, towards the camera.
            to_sun: (3,) unit; everything in the target frame.
        """
        at, cosine, start = facing(points_m, normals, to_sun, _GRAZING, self._shadow_start_m)
        out = np.zeros(len(points_m), np.float32)
        reached = ~self._caster.occluded(start, np.broadcast_to(to_sun, start.shape))
        out[at[reached]] = cosine[reached]
        return out


@dataclass(frozen=True, eq=False)
class ContourLines:
    """The contour of a view in the form that the solver takes.

    Attributes:
        points_m: (N, 3) in the target frame.
        lines: (N, 5) outward normal (2), contour length it stands for, free distance inwards and outwards; pixels of
            the image.
    """

    points_m: Float
    lines: Float

    @property
    def length_px(self) -> float:
        """Length of the contour, pixels of the image."""
        return float(self.lines[:, 2].sum())


def contour_lines(view: View, max_points: int) -> ContourLines:
    """Sample the contour of a view; where a sun is known, only what it shines on, since the rest cannot be seen."""
    table = contour_table(view.depth_m, view.mask, view.camera.K, max_points)
    if view.lit is not None:
        inner = np.rint(table[:, [COL_V, COL_U]] - table[:, [COL_NV, COL_NU]]).astype(np.intp)
        table = table[view.lit[inner[:, 0], inner[:, 1]]]
    points = (table[:, :3] - view.T_cam_target[:3, 3]) @ view.T_cam_target[:3, :3]
    # In rows, as the solver's other callers have them: another memory layout would be compiled once more.
    lines = np.ascontiguousarray(table[:, [COL_NU, COL_NV, COL_WEIGHT, COL_INSIDE, COL_OUTSIDE]])
    lines[:, 2:] /= view.scale
    return ContourLines(points, lines)
