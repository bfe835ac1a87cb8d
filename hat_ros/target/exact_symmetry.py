"""Exact symmetries of a CAD model: motions after which it looks the same from everywhere, in shape and in colours.

Two renderings are compared pixel by pixel, in depth and albedo, each pixel with those around it in the other: what lies
within a pixel of the other's is the same. So what can be seen decides, not how the surface is cut into triangles or
what is inside. A part that one rendering has and the other lacks is a difference, however small, once a ray meets it.

What hardly changes the silhouette only is a near-symmetry, see :mod:`hat_ros.target.symmetry`.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from hat_ros.array_types import Bool, Float
from hat_ros.cache import cached_arrays
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry, about_center, symmetry_of_turns
from hat_ros.target.model import Target
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.rendering import Rendering
from hat_ros.target.sphere import look_inwards
from hat_ros.types import Camera

_FORMAT = 1
# What a pixel shows is what counts as seen: a 60th of the radius.
_SIDE_PX = 128
_DISTANCE_RADII = 6.0
_N_VIEWS = 12
# Colours this close (of 255) are the same to a camera with some noise.
_COLOR_LEVELS = 16
# Turns about one axis that are tried: a prism with more sides is a body of revolution to within a pixel.
_FOLDS = tuple(range(2, 19))
# Turns that no regular polygon with few sides shares: a body that they leave alone is one of revolution.
_ODD_TURNS_RAD = (1.0, 2.4, 0.37)
# Axes that are tried: of the file, of inertia, and so many each of the largest faces and the outermost corners.
_N_AXES = 12
_SAME_AXIS_DEG = 1.0


def symmetry_of(target: Target) -> Symmetry:
    """The symmetry that the target is tracked with: as ``target.yaml`` declares it, else :func:`exact_symmetry`.

    What was found is kept in the cache folder.
    """
    if target.declared_symmetry is not None:
        return target.declared_symmetry
    key = f"{target.sha256}:{_FORMAT}:{_SIDE_PX}:{_N_VIEWS}:{_COLOR_LEVELS}:{_FOLDS[-1]}:{_N_AXES}"

    def build() -> dict[str, Float]:
        found = exact_symmetry(target)
        return {"turns": found.turns, "axes": found.axes, "center_m": found.center_m}

    return Symmetry(**cached_arrays("symmetry", key, build))


def exact_symmetry(target: Target) -> Symmetry:
    """The rotations that leave all that can be seen of a target where it is, about the middle of its convex hull."""
    center_m, axes = _candidate_axes(target)
    looks = _Looks(target, center_m)
    free: list[Float] = []
    for axis in axes:
        if looks.same(_turn(axis, angle) for angle in _ODD_TURNS_RAD):
            free.append(axis)
            if len(free) > 1:  # a ball
                break
    if free:  # across a single free axis one turn is as good as another
        turns = [_turn(_across(free[0]), np.pi)] if len(free) == 1 else []
    else:
        turns = [_turn(axis, 2.0 * np.pi / fold) for axis in axes for fold in _FOLDS]
    motions = [about_center(turn, center_m) for turn in turns if looks.same([turn])]
    try:
        return symmetry_of_turns(np.array(motions).reshape(-1, 4, 4), np.array(free).reshape(-1, 3), center_m)
    except ValueError:  # turns that are within a pixel of one another's products, but no group
        return Symmetry()


def _turn(axis: Float, angle_rad: float) -> Float:
    return lie.so3_exp(angle_rad * axis)


def _across(axis: Float) -> Float:
    """(3,) a unit vector at a right angle to one."""
    other = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    return other / np.linalg.norm(other)


def _candidate_axes(target: Target) -> tuple[Float, list[Float]]:
    """A point that every symmetry leaves alone (3,), and unit axes (3,) that some may turn about."""
    center_m, inertia = target.center_m, np.eye(3)
    try:
        hull = trimesh.convex.convex_hull(target.hull_m)
        center_m, inertia = np.asarray(hull.center_mass), np.asarray(hull.moment_inertia)
    except QhullError:  # flat: the middle of its box serves if the box lies along the axes of the file
        pass
    vectors = [*np.eye(3), *np.linalg.eigh(inertia)[1].T]
    order = np.argsort(-target.face_areas_m2, kind="stable")
    vectors += _distinct(target.face_normals[order], _N_AXES)
    outward = target.hull_m - center_m
    vectors += _distinct(outward[np.argsort(-np.linalg.norm(outward, axis=1), kind="stable")], _N_AXES)
    return center_m, _distinct(np.array(vectors), len(vectors))


def _distinct(vectors: Float, count: int) -> list[Float]:
    """The first ``count`` different directions, of either sign, as unit vectors (3,)."""
    kept: list[Float] = []
    length = np.linalg.norm(vectors, axis=1)
    for unit in vectors[length > 0] / length[length > 0, None]:
        if not kept or np.abs(np.stack(kept) @ unit).max() < np.cos(np.radians(_SAME_AXIS_DEG)):
            kept.append(unit)
            if len(kept) == count:
                break
    return kept


class _Looks:
    """A target as it looks from all sides, and turned about its middle."""

    def __init__(self, target: Target, center_m: Float) -> None:
        self._target, self._center_m = target, center_m
        focal = 0.47 * _SIDE_PX * np.sqrt(_DISTANCE_RADII**2 - 1.0)
        middle = (_SIDE_PX - 1) / 2
        self._radius_m = float(np.linalg.norm(target.hull_m - center_m, axis=1).max())
        self._camera = Camera(np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]]), _SIDE_PX, _SIDE_PX)
        self._position = np.array([0.0, 0.0, _DISTANCE_RADII * self._radius_m])
        self._views = look_inwards(_N_VIEWS)
        self._pixel_m = self._position[2] / focal
        self._as_it_is: dict[int, _Look] = {}

    @cached_property
    def _renderer(self) -> RayRenderer:
        return RayRenderer(self._target)

    @cached_property
    def _planes(self) -> Float:
        """(P, 4) outward normals and offsets of the hull's facets about the middle; none if it is flat."""
        try:
            return ConvexHull(self._target.hull_m - self._center_m).equations
        except QhullError:
            return np.zeros((0, 4))

    def same(self, turns: Iterable[Float]) -> bool:
        """Whether the target looks the same after each of these turns (3, 3)."""
        return all(self._hull_fits(turn) and self._looks_same(turn) for turn in turns)

    def _hull_fits(self, turn: Float) -> bool:
        """Whether the turned hull stays within a pixel of the hull; quick, and most turns end here."""
        points = (self._target.hull_m - self._center_m) @ turn.T
        beyond = points @ self._planes[:, :3].T + self._planes[:, 3]
        return bool((beyond <= self._pixel_m).all())

    def _looks_same(self, turn: Float) -> bool:
        for index, R in enumerate(self._views):
            if index not in self._as_it_is:
                self._as_it_is[index] = self._look(R)
            if not self._as_it_is[index].is_like(self._look(R @ turn), self._pixel_m):
                return False
        return True

    def _look(self, R_cam_target: Float) -> _Look:
        T = lie.transform(R_cam_target, self._position - R_cam_target @ self._center_m)
        return _Look(self._renderer.render(T, self._camera))


class _Look:
    """One rendering, and the ranges of depth and colour within a pixel of each pixel."""

    def __init__(self, rendering: Rendering) -> None:
        self._inside = rendering.mask
        self._depth_m = np.where(self._inside, rendering.depth_m, np.inf).astype(np.float32)
        self._rgb = rendering.rgb

    @cached_property
    def _near_depth(self) -> tuple[NDArray[Any], NDArray[Any]]:
        return _range(self._depth_m)

    @cached_property
    def _near_rgb(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Of what is inside alone."""
        inside = self._inside[..., None]
        dark, bright = (np.where(inside, self._rgb, outside).astype(np.uint8) for outside in (255, 0))
        return _range(dark)[0], _range(bright)[1]

    def is_like(self, other: _Look, pixel_m: float) -> bool:
        """Whether each pixel of either has its like in the other."""
        return bool(self._has(other, pixel_m).all() and other._has(self, pixel_m).all())

    def _has(self, other: _Look, pixel_m: float) -> Bool:
        """(H, W) pixels of another look that are within the ranges of this one's, to within a pixel's depth."""
        low, high = self._near_depth
        found: Bool = (other._depth_m >= low - pixel_m) & (other._depth_m <= high + pixel_m)
        dark, bright = (level.astype(np.int16) for level in self._near_rgb)
        rgb = other._rgb.astype(np.int16)
        colors = ((rgb >= dark - _COLOR_LEVELS) & (rgb <= bright + _COLOR_LEVELS)).all(axis=-1)
        return found & (colors | ~other._inside)


def _range(values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Least and greatest value within a pixel of each."""
    square = np.ones((3, 3), np.uint8)
    return cv2.erode(values, square), cv2.dilate(values, square)
