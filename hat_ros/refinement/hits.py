"""Points, normals and sun incidence where rays hit a surface. Compiled: small loops, thousands of calls a second."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hat_ros.array_types import Float, Float32, Int32


@njit(cache=True, nogil=True)
def hit_points(
    origins_m: Float32, directions: Float32, face: Int32, distance: Float32
) -> tuple[NDArray[np.intp], Float32]:
    """Which of N rays hit something (M,), and where (M, 3).

    Args:
        origins_m, directions: (N, 3) of the rays.
        face: (N,) face that each hit, -1 = none.
        distance: (N,) ray parameter of the hit.
    """
    at, points = np.empty(len(face), np.intp), np.empty((len(face), 3), np.float32)
    n = 0
    for i in range(len(face)):
        if face[i] >= 0:
            at[n] = i
            for k in range(3):
                points[n, k] = origins_m[i, k] + directions[i, k] * distance[i]
            n += 1
    return at[:n], points[:n]


@njit(cache=True, nogil=True)
def normals_towards(directions: Float32, face: Int32, face_normals: Float32) -> Float32:
    """Normals (N, 3) of faces (N,) on the side that rays (N, 3) came from, however the file winds them."""
    out = np.empty((len(face), 3), np.float32)
    for i in range(len(face)):
        n = face_normals[face[i]]
        away = n[0] * directions[i, 0] + n[1] * directions[i, 1] + n[2] * directions[i, 2] > 0
        sign = np.float32(-1.0 if away else 1.0)
        for k in range(3):
            out[i, k] = sign * n[k]
    return out


@njit(cache=True, nogil=True)
def facing(
    points_m: Float32, normals: Float32, to_sun: Float32, least_cosine: float, offset_m: float
) -> tuple[NDArray[np.intp], Float32, Float32]:
    """Which of N points face the sun.

    Args:
        points_m, normals: (N, 3) of the surface, normals on the side that is seen.
        to_sun: (3,) unit.
        least_cosine: of the sun's incidence.
        offset_m: how far off the surface a shadow ray starts.

    Returns:
        Which (M,), the cosine (M,), and the start (M, 3) of a ray to the sun.
    """
    at, cosine = np.empty(len(points_m), np.intp), np.empty(len(points_m), np.float32)
    start = np.empty((len(points_m), 3), np.float32)
    offset = np.float32(offset_m)
    n = 0
    for i in range(len(points_m)):
        c = normals[i, 0] * to_sun[0] + normals[i, 1] * to_sun[1] + normals[i, 2] * to_sun[2]
        if c > least_cosine:
            at[n], cosine[n] = i, c
            for k in range(3):
                start[n, k] = points_m[i, k] + offset * normals[i, k]
            n += 1
    return at[:n], cosine[:n], start[:n]


@njit(cache=True, nogil=True)
def image_box(points_m: Float, R: Float, t: Float, K: Float, near_m: float) -> Float | None:
    """Box (x0, y0, x1, y1) in pixels of points (N, 3) at a pose (3, 3), (3,); None unless all lie beyond ``near_m``."""
    box = np.array([np.inf, np.inf, -np.inf, -np.inf])
    for i in range(len(points_m)):
        x, y, z = points_m[i]
        depth = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        if not near_m < depth < np.inf:
            return None
        a = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) / depth
        b = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) / depth
        u, v = K[0, 0] * a + K[0, 1] * b + K[0, 2], K[1, 1] * b + K[1, 2]
        box[0], box[1] = min(box[0], u), min(box[1], v)
        box[2], box[3] = max(box[2], u), max(box[3], v)
    return box if np.isfinite(box).all() else None
