"""Triangles to samples on the CPU, compiled: several samples per pixel, no clipping, the interpreter lock released.

Everything about a triangle that varies over the image is affine in the pixel. With corners ``p0, p1, p2`` in the camera
frame and the ray ``d = K^-1 [u, v, 1]``, the numbers ``b0 = d . (p1 x p2) / V``, ``b1 = d . (p2 x p0) / V`` and
``b2 = d . (p0 x p1) / V`` with ``V = p0 . (p1 x p2)`` are all positive exactly where the ray meets the triangle, in
front of the camera; their sum is the inverse depth, and divided by it they are the barycentric weights. So nothing has
to be clipped, not even a triangle that reaches behind the camera. Olano and Greer, "Triangle Scan Conversion using 2D
Homogeneous Coordinates", Graphics Hardware 1997.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hat_ros.array_types import Float, Int32

# Corners nearer than this share of the farthest one do not bound their triangle's image: it may cover anything.
_NEAR = 1e-4


@njit(cache=True, nogil=True)
def edge_functions(corners: Float, rays: Float) -> Float:
    """Coefficients of ``b0, b1, b2`` over ``(u, v, 1)``: (F, 3, 3) corners in the camera frame, K^-1 -> (F, 3, 3).

    A triangle seen edge on gets NaN.
    """
    out = np.empty((len(corners), 3, 3))
    for f in range(len(corners)):
        p = corners[f]
        volume = 0.0
        for i in range(3):
            a, b = p[(i + 1) % 3], p[(i + 2) % 3]
            normal = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
            if i == 0:
                volume = p[0, 0] * normal[0] + p[0, 1] * normal[1] + p[0, 2] * normal[2]
            scale = 1.0 / volume if volume != 0.0 else np.nan
            for k in range(3):
                out[f, i, k] = scale * (normal[0] * rays[0, k] + normal[1] * rays[1, k] + normal[2] * rays[2, k])
    return out


@njit(cache=True, nogil=True)
def nearest_faces(
    corners: Float,
    K: Float,
    edges: Float,
    samples: Float,
    width: int,
    height: int,
) -> Int32:
    """The face that each sample sees: (height, width, S) int32, -1 = none.

    Args:
        corners: (F, 3, 3) corners in the camera frame.
        K: (3, 3) intrinsics, zero below the diagonal.
        edges: (F, 3, 3) of :func:`edge_functions`.
        samples: (S, 2) positions within a pixel, added to its column and row.
        width: pixels.
        height: pixels.
    """
    n_samples = len(samples)
    face = np.full((height, width, n_samples), -1, np.int32)
    nearest = np.zeros((height, width, n_samples))
    offset, reach = np.empty((n_samples, 3)), np.empty(3)
    for f in range(len(corners)):
        b = edges[f]
        if np.isnan(b[0, 0]):
            continue
        for i in range(3):
            reach[i] = -np.inf
            for s in range(n_samples):
                offset[s, i] = b[i, 0] * samples[s, 0] + b[i, 1] * samples[s, 1] + b[i, 2]
                reach[i] = max(reach[i], offset[s, i])
        x0, y0, x1, y1 = _pixels(corners[f], K, width, height)
        for y in range(y0, y1):
            for x in range(x0, x1):
                a0, a1, a2 = b[0, 0] * x + b[0, 1] * y, b[1, 0] * x + b[1, 1] * y, b[2, 0] * x + b[2, 1] * y
                if a0 + reach[0] < 0.0 or a1 + reach[1] < 0.0 or a2 + reach[2] < 0.0:
                    continue  # no sample of this pixel is inside
                for s in range(n_samples):
                    b0, b1, b2 = a0 + offset[s, 0], a1 + offset[s, 1], a2 + offset[s, 2]
                    if b0 >= 0.0 and b1 >= 0.0 and b2 >= 0.0 and b0 + b1 + b2 > nearest[y, x, s]:
                        nearest[y, x, s] = b0 + b1 + b2
                        face[y, x, s] = f
    return face


@njit(cache=True, nogil=True)
def _pixels(corners: Float, K: Float, width: int, height: int) -> tuple[int, int, int, int]:
    """Half-open columns and rows of the pixels that a triangle can reach: x0, y0, x1, y1."""
    far = max(corners[0, 2], corners[1, 2], corners[2, 2])
    near = min(corners[0, 2], corners[1, 2], corners[2, 2])
    if far <= 0.0:
        return 0, 0, 0, 0
    if near <= _NEAR * far:
        return 0, 0, width, height
    u0, v0, u1, v1 = np.inf, np.inf, -np.inf, -np.inf
    for i in range(3):
        x, y, z = corners[i]
        u = (K[0, 0] * x + K[0, 1] * y) / z + K[0, 2]
        v = K[1, 1] * y / z + K[1, 2]
        u0, v0, u1, v1 = min(u0, u), min(v0, v), max(u1, u), max(v1, v)
    # Samples lie within [0, 1) of their pixel's index.
    x0, y0 = int(min(max(np.floor(u0), 0.0), width)), int(min(max(np.floor(v0), 0.0), height))
    x1, y1 = int(min(max(np.floor(u1) + 1.0, 0.0), width)), int(min(max(np.floor(v1) + 1.0, 0.0), height))
    return x0, y0, x1, y1
