"""Symmetries of a rigid body: the motions that map it onto itself, so that no image tells two of its poses apart.

A pose ``T_cam_target`` of a body with the symmetry S (a motion of the target frame) looks like ``T_cam_target @ S``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.geometry import lie

# The rotations of an icosahedron are 60; a prism with more sides is taken for a body of revolution.
MAX_ORDER = 120
# Turns closer than this are the same; the closest of a group of MAX_ORDER turns are 3 degrees apart.
_SAME_DEG = 1.0
# A turn maps an axis onto itself if it stays within this angle of it.
_ON_AXIS_DEG = 1.0
# Variance of an angle of which nothing is known: uniform over a full turn, rad^2.
FREE_VARIANCE_RAD2 = np.pi**2 / 3.0


@dataclass(frozen=True, eq=False)
class Symmetry:
    """A group of motions of the target frame.

    Attributes:
        turns: (S, 4, 4) the discrete ones, the identity first; beside a free axis one for each end of it.
        axes: (A, 3) unit axes about which any turn is one: none, one (a body of revolution), or three (a ball).
        center_m: (3,) a point that all of them leave where it is.
    """

    turns: Float = field(default_factory=lambda: np.eye(4)[None])
    axes: Float = field(default_factory=lambda: np.zeros((0, 3)))
    center_m: Float = field(default_factory=lambda: np.zeros(3))

    @property
    def order(self) -> int:
        """Number of discrete motions, the identity included."""
        return len(self.turns)

    @cached_property
    def is_trivial(self) -> bool:
        """Only the identity: every pose is its own."""
        return self.order == 1 and not len(self.axes)

    def nearest(self, T_cam_target: Float, R_reference: Float) -> Float:
        """Of all poses that look like a pose the one whose rotation is nearest to a reference.

        Args:
            T_cam_target: (..., 4, 4) poses.
            R_reference: (..., 3, 3) rotations ``R_cam_target``.

        Returns:
            (..., 4, 4); the same array if there is no symmetry.
        """
        if self.is_trivial:
            return T_cam_target
        if len(self.axes) > 1:
            R_cam_target = T_cam_target[..., :3, :3]
            R = np.broadcast_to(R_reference, R_cam_target.shape)
            return lie.transform(R, T_cam_target[..., :3, 3] + (R_cam_target - R) @ self.center_m)
        like = T_cam_target[..., None, :, :] @ self.turns
        reference = np.asarray(R_reference)[..., None, :, :]
        if len(self.axes):
            like = like @ self._spin_towards(like[..., :3, :3], reference)
        apart = lie.angle_between(like[..., :3, :3], reference)
        best = np.argmin(apart, axis=-1)[..., None, None, None]
        return np.take_along_axis(like, best, axis=-3)[..., 0, :, :]

    def _spin_towards(self, R_cam_target: Float, R_reference: Float) -> Float:
        """(..., 4, 4) turns about the free axis that bring rotations nearest to others: the largest trace."""
        axis = self.axes[0]
        M = np.swapaxes(R_reference, -1, -2) @ R_cam_target
        sine = np.einsum("...ij,ji->...", M, lie.hat(axis))
        cosine = np.trace(M, axis1=-2, axis2=-1) - np.einsum("i,...ij,j->...", axis, M, axis)
        return self._about(np.arctan2(sine, cosine)[..., None] * axis)

    def _about(self, rotvec: Float) -> Float:
        """(..., 4, 4) turns (..., 3) about the centre."""
        R = lie.so3_exp(rotvec)
        return lie.transform(R, self.center_m - R @ self.center_m)

    def free_covariance(self, T_cam_target: Float) -> Float:
        """(6, 6) of ``[translation; rotation vector]``: nothing is known of a turn about a free axis; zero without one.

        The variance of an angle that is uniform over a full turn, pi^2 / 3 rad^2 (104 deg, one sigma).
        """
        covariance = np.zeros((6, 6))
        R = T_cam_target[:3, :3]
        for axis in self.axes:
            turn = R @ axis
            direction = np.concatenate([-np.cross(turn, R @ self.center_m), turn])
            covariance += FREE_VARIANCE_RAD2 * np.outer(direction, direction)
        return covariance

    def sampled(self, step: float = 0.01) -> Float:
        """(E, 4, 4) motions, free turns at equal steps.

        As the BOP toolkit samples them (``get_symmetry_transformations``): pi / ``step`` turns, so that no vertex moves
        by more than about this share of the diameter from one to the next.

        Raises:
            ValueError: any turn is a symmetry: these cannot be listed.
        """
        if len(self.axes) > 1:
            raise ValueError("the turns of a ball cannot be listed")
        if not len(self.axes):
            return self.turns
        count = int(np.ceil(np.pi / step))
        angles = 2.0 * np.pi / count * np.arange(count)
        free = self._about(angles[:, None] * self.axes[0])
        return (free[None] @ self.turns[:, None]).reshape(-1, 4, 4)

    def words(self) -> str:
        """What it says about a pose, for people; empty without a symmetry."""
        return known_up_to(self.order, len(self.axes))


def known_up_to(order: int, free_axes: int) -> str:
    """How far a pose is known that has so many equals, and so many free axes; empty if it has none."""
    if free_axes > 1:
        return "known up to any turn"
    if free_axes:
        return "known up to a turn about its axis" + (" and which end is which" if order > 1 else "")
    return f"known up to {order} equal orientations" if order > 1 else ""


def about_center(R: Float, center_m: Float) -> Float:
    """(..., 4, 4) motions that turn (..., 3, 3) about a point (3,)."""
    return lie.transform(R, center_m - R @ center_m)


def symmetry_of_turns(turns: Float, axes: Float, center_m: Float) -> Symmetry:
    """The group that motions and free axes generate.

    Args:
        turns: (S, 4, 4) motions, the identity or not.
        axes: (A, 3) free axes, of any number and length.
        center_m: (3,) a point on all axes.

    Raises:
        ValueError: they generate no finite group of at most ``MAX_ORDER`` turns.
    """
    free = np.zeros((0, 3))
    for axis in axes / np.linalg.norm(axes, axis=1, keepdims=True):
        if not _is_along(axis, free):
            free = np.vstack([free, axis])
    if len(free) > 1 or (len(free) and not all(_is_along(T[:3, :3] @ free[0], free) for T in turns)):
        return Symmetry(axes=np.eye(3), center_m=center_m)
    if len(free):
        flips = [T for T in turns if (T[:3, :3] @ free[0]) @ free[0] < 0]
        return Symmetry(np.stack([np.eye(4), *flips[:1]]), free, center_m)
    return Symmetry(_closed(turns), free, center_m)


def _is_along(axis: Float, others: Float) -> bool:
    return bool((np.abs(others @ axis) >= np.cos(np.radians(_ON_AXIS_DEG))).any())


def _closed(generators: Float) -> Float:
    """(S, 4, 4) all products of motions, the identity first."""
    group = np.eye(4)[None]
    new = group
    while len(new):
        products = (new[:, None] @ generators[None]).reshape(-1, 4, 4)
        kept: list[Float] = []
        for T in products:
            known = np.concatenate([group, np.stack(kept)]) if kept else group
            if lie.angle_between(known[:, :3, :3], T[:3, :3]).min() > np.radians(_SAME_DEG):
                kept.append(T)
            if len(group) + len(kept) > MAX_ORDER:
                raise ValueError(f"they generate more than {MAX_ORDER} different turns")
        new = np.stack(kept) if kept else group[:0]
        group = np.concatenate([group, new])
    return group


def symmetry_from_declaration(discrete: Any, continuous: Any, unit_m: float) -> Symmetry:
    """A symmetry as BOP's ``models_info.json`` declares it.

    Args:
        discrete: ``symmetries_discrete``: rigid 4 x 4 matrices, 16 numbers each, row by row.
        continuous: ``symmetries_continuous``: mappings with ``axis`` and ``offset``, a point on it, 3 numbers each.
        unit_m: metres per unit of translations and offsets.

    Raises:
        ValueError: malformed, in words.
    """
    turns = [np.eye(4)]
    for index, item in enumerate(_sequence(discrete, "symmetries_discrete")):
        T = _numbers(item, 16, f"symmetries_discrete[{index}]").reshape(4, 4)
        T[:3, 3] *= unit_m
        if not lie.is_rigid(T):
            raise ValueError(f"symmetries_discrete[{index}] is no rigid motion, found {np.asarray(item).tolist()}")
        turns.append(T)
    axes, points = [], []
    for index, item in enumerate(_sequence(continuous, "symmetries_continuous")):
        name = f"symmetries_continuous[{index}]"
        if not isinstance(item, Mapping) or set(item) != {"axis", "offset"}:
            raise ValueError(f"{name} must have 'axis' and 'offset', found {item!r}")
        axis = _numbers(item["axis"], 3, f"{name}.axis")
        if not np.linalg.norm(axis) > 0:
            raise ValueError(f"{name}.axis must not be zero")
        axes.append(axis)
        points.append(_numbers(item["offset"], 3, f"{name}.offset") * unit_m)
    motions = np.stack(turns)
    center = points[0] if points else _fixed_point(motions)
    try:
        return symmetry_of_turns(motions, np.array(axes).reshape(-1, 3), center)
    except ValueError as error:
        raise ValueError(f"symmetries_discrete: {error}") from None


def _fixed_point(motions: Float) -> Float:
    """(3,) the point that motions (S, 4, 4) move least."""
    A = (np.eye(3) - motions[:, :3, :3]).reshape(-1, 3)
    point, *_ = np.linalg.lstsq(A, motions[:, :3, 3].reshape(-1), rcond=None)
    return np.asarray(point, dtype=np.float64)


def _sequence(value: Any, name: str) -> Sequence[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{name} must be a list, found {value!r}")
    return value


def _numbers(value: Any, count: int, name: str) -> Float:
    try:
        numbers = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{name} must be {count} finite numbers, found {value!r}")
    return numbers


def declaration_of(symmetry: Symmetry) -> dict[str, list[Any]]:
    """The keys of a ``target.yaml`` that declare a symmetry, in metres."""
    offset = symmetry.center_m.tolist()
    return {
        "symmetries_discrete": [T.ravel().tolist() for T in symmetry.turns[1:]],
        "symmetries_continuous": [{"axis": axis.tolist(), "offset": offset} for axis in symmetry.axes],
    }
