"""Directions spread over the sphere, and rotations of cameras that look along them."""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Float
from hat_ros.errors import UsageError
from hat_ros.geometry import lie

Face = tuple[int, int, int]

_GOLDEN = (1.0 + np.sqrt(5.0)) / 2.0
_CORNERS = [(-1, _GOLDEN, 0), (1, _GOLDEN, 0), (-1, -_GOLDEN, 0), (1, -_GOLDEN, 0)]
_CORNERS += [(0, -1, _GOLDEN), (0, 1, _GOLDEN), (0, -1, -_GOLDEN), (0, 1, -_GOLDEN)]
_CORNERS += [(_GOLDEN, 0, -1), (_GOLDEN, 0, 1), (-_GOLDEN, 0, -1), (-_GOLDEN, 0, 1)]
_FACES: list[Face] = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4)]
_FACES += [(11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5)]
_FACES += [(2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
# A direction this close to a pole has no horizon of its own.
_POLE_TOLERANCE = 1e-3


def icosphere(n_vertices: int) -> Float:
    """Unit vertices (n_vertices, 3) of an icosahedron whose edges are halved again and again.

    Raises:
        UsageError: ``n_vertices`` is not one of 12, 42, 162, 642, 2562, ... (``10 * 4**n + 2``).
    """
    points, faces = [np.array(corner) / np.linalg.norm(corner) for corner in _CORNERS], _FACES
    while len(points) < n_vertices:
        points, faces = _halved(points, faces)
    if len(points) != n_vertices:
        raise UsageError(f"an icosphere has 12, 42, 162, 642, 2562, ... vertices, not {n_vertices}")
    return np.array(points)


def _halved(points: list[Float], faces: list[Face]) -> tuple[list[Float], list[Face]]:
    """Every edge halved, every face made four, the new vertices pushed out to the sphere."""
    points, finer = list(points), []
    middles: dict[tuple[int, int], int] = {}
    for face in faces:
        mids = []
        for i, j in zip(face, face[1:] + face[:1], strict=True):
            edge = (min(i, j), max(i, j))
            if edge not in middles:
                middles[edge] = len(points)
                total = points[i] + points[j]
                points.append(total / np.linalg.norm(total))
            mids.append(middles[edge])
        (a, b, c), (ab, bc, ca) = face, mids
        finer += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return points, finer


def upright_icosphere(n_vertices: int) -> Float:
    """An icosphere (n_vertices, 3) with vertices on the z axis, sorted by elevation, then by atan2(x, y).

    The order of the template sets that the published networks use.
    """
    to_pole = lie.so3_exp(np.array([0.0, 0.0, np.pi / 2])) @ lie.so3_exp(np.array([np.arctan2(1.0, _GOLDEN), 0.0, 0.0]))
    vertices = icosphere(n_vertices) @ to_pole.T
    x, y, z = np.round(vertices, 9).T + 0.0  # rounding must not decide on which side of a half turn a vertex lies
    elevation = np.round(np.arcsin(np.clip(z, -1, 1)), 6)
    return vertices[np.lexsort((np.arctan2(x, y), elevation))]


def even_directions(count: int) -> Float:
    """(count, 3) unit vectors spread evenly over the sphere, any number of them (Fibonacci spiral)."""
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * index
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def look_along(forward: Float, down: Float) -> Float:
    """Rotations ``R_cam_target`` of cameras with given optical axes: (N, 3), (N, 3) -> (N, 3, 3).

    Args:
        forward: unit direction of each optical axis, target frame.
        down: direction of any length, target frame, which image y follows as far as the optical axis allows.
    """
    x = np.cross(down, forward)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(forward, x), forward], axis=1)


def look_inwards(n_views: int) -> Float:
    """(n_views, 3, 3) ``R_cam_target`` of cameras on an icosphere around the target that look at its middle."""
    forward = -icosphere(n_views)
    upright = np.abs(forward[:, 2:]) < 0.9
    return look_along(forward, np.where(upright, np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 1.0, 0.0]])))


def look_inwards_upright(n_views: int) -> Float:
    """The same with the target's z axis up in the image, the poles' y axis: the published template sets."""
    forward = -upright_icosphere(n_views)
    at_pole = np.abs(np.abs(forward[:, 2:]) - 1.0) < _POLE_TOLERANCE
    return look_along(forward, np.where(at_pole, np.array([[0.0, -1.0, 0.0]]), np.array([[0.0, 0.0, -1.0]])))
