"""Views from all sides: the 162 cameras of the published template sets."""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Float

_POLE_TOLERANCE = 1e-3


def icosphere(n_subdivisions: int) -> Float:
    """Unit vectors (10 * 4**n + 2, 3) of an icosahedron with poles on the z axis, each edge halved n times.

    Sorted by elevation, then by atan2(x, y).
    """
    azimuth = 2 * np.pi * np.arange(5) / 5
    height = 1 / np.sqrt(5)
    upper = height * np.stack([2 * np.cos(azimuth), 2 * np.sin(azimuth), np.ones(5)], axis=1)
    vertices = np.concatenate([[[0, 0, 1]], upper, -upper, [[0, 0, -1]]])
    edge = np.linalg.norm(vertices[0] - vertices[1])
    for _ in range(n_subdivisions):
        distance = np.linalg.norm(vertices[:, None] - vertices[None], axis=2)
        # Halving pulls edges apart by a few per cent; the next shortest distance is a diagonal, 40 % longer.
        i, j = np.nonzero(np.triu((distance > 0) & (distance < 1.25 * edge)))
        middle = vertices[i] + vertices[j]
        vertices = np.concatenate([vertices, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        edge /= 2
    elevation = np.round(np.arcsin(np.clip(vertices[:, 2], -1, 1)), 6)
    return vertices[np.lexsort((np.arctan2(vertices[:, 0], vertices[:, 1]), elevation))]


def look_at_origin(position: Float) -> Float:
    """Rotations ``R_cam_target`` of cameras at ``position`` that look at the origin, image x horizontal: (N, 3, 3)."""
    forward = -position / np.linalg.norm(position, axis=1, keepdims=True)
    helper = np.broadcast_to([0.0, 0.0, -1.0], forward.shape).copy()
    helper[np.abs(np.abs(forward[:, 2]) - 1) < _POLE_TOLERANCE] = [0.0, -1.0, 0.0]
    right = np.cross(helper, forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1)
