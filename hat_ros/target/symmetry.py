"""Near-symmetries: turns that hardly change a target's silhouettes, so that a mask alone is ambiguous.

A body with two or four equal sides is often asymmetric in details only, an antenna or a colour. A search by shape may
find one of its orientations only, and a predicted pose brings only its own.
"""

from __future__ import annotations

import hashlib

import numpy as np
from scipy.spatial.transform import Rotation

from hat_ros.array_types import Float, UInt8
from hat_ros.cache import cached_arrays
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry
from hat_ros.target.exact_symmetry import symmetry_of
from hat_ros.target.masks import overlap
from hat_ros.target.model import Target
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.sphere import look_inwards
from hat_ros.types import Camera

_FORMAT = 1
_SIDE_PX = 64
_DISTANCE_RADII = 6.0
# Mean overlap of silhouettes from so many sides, and the most turns that are kept.
_N_VIEWS = 12
_MIN_OVERLAP = 0.85
_MAX_TURNS = 3
# Turns closer than this to none, or to one another, are the same.
_SEPARATION_DEG = 15.0


def load_or_find_symmetries(target: Target) -> Float:
    """:func:`near_symmetries` from the cache folder, found and stored there when it is absent or damaged."""
    key = f"{target.sha256}:{_FORMAT}:{_SIDE_PX}:{_DISTANCE_RADII}:{_N_VIEWS}:{_MIN_OVERLAP}:{_MAX_TURNS}"
    exact = symmetry_of(target)
    if not exact.is_trivial:
        digest = hashlib.sha256(np.concatenate([exact.turns.ravel(), exact.axes.ravel()]).tobytes())
        key = f"{key}:{digest.hexdigest()}"
    return cached_arrays("near-symmetries", key, lambda: {"turns": near_symmetries(target, exact)})["turns"]


def near_symmetries(target: Target, exact: Symmetry | None = None) -> Float:
    """(S, 3, 3) rotations of the target about its centre, those that change its silhouettes least first.

    Quarter, third and half turns about the axes of the file and about the principal axes of the surface, but for those
    that an exact symmetry makes equal to none.
    """
    renderer = RayRenderer(target)
    focal = 0.47 * _SIDE_PX * np.sqrt(_DISTANCE_RADII**2 - 1.0)
    middle = (_SIDE_PX - 1) / 2
    camera = Camera(np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]]), _SIDE_PX, _SIDE_PX)
    position = np.array([0.0, 0.0, _DISTANCE_RADII * target.bounding_radius_m])

    def silhouettes(turn: Float) -> list[UInt8]:
        poses = (lie.transform(R @ turn, position - R @ turn @ target.center_m) for R in look_inwards(_N_VIEWS))
        return [renderer.quick_silhouette(T, camera).view(np.uint8) for T in poses]

    as_it_is = silhouettes(np.eye(3))
    turns = _turns(target)
    if exact is not None and not exact.is_trivial:
        nearest = exact.nearest(lie.transform(turns, np.zeros((len(turns), 3))), np.eye(3))
        turns = turns[np.degrees(lie.angle_between(nearest[:, :3, :3], np.eye(3))) > _SEPARATION_DEG]
        if not len(turns):
            return turns
    alike = np.array([np.mean([overlap(a, b) for a, b in zip(as_it_is, silhouettes(t), strict=True)]) for t in turns])
    order = np.argsort(-alike, kind="stable")
    return turns[order[alike[order] >= _MIN_OVERLAP][:_MAX_TURNS]]


def turned(T_cam_target: Float, turn: Float, center_m: Float) -> Float:
    """A pose (4, 4) with the target turned (3, 3) about a point of its own (3,)."""
    R = T_cam_target[:3, :3]
    return lie.transform(R @ turn, T_cam_target[:3, 3] + R @ (center_m - turn @ center_m))


def _turns(target: Target) -> Float:
    """(N, 3, 3) the turns of a cube, but for none, about both sets of axes."""
    weights = np.repeat(target.face_areas_m2, 3)
    _, axes = np.linalg.eigh(np.cov(target.corners_m.reshape(-1, 3).T, aweights=weights))
    kept = [np.eye(3)]
    for about in (np.eye(3), axes):
        for cube in np.rint(Rotation.create_group("O").as_matrix()):
            turn = about @ cube @ about.T
            if np.degrees(lie.angle_between(np.stack(kept), turn)).min() > _SEPARATION_DEG:
                kept.append(turn)
    return np.stack(kept[1:])
