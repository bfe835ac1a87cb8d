"""The apparent contour of a rendered view: sub-pixel points, their normals, depth and free distances.

Compiled. Pixel centres lie at integer coordinates; the boundary between a target pixel and a background pixel lies
half-way between their centres, refined to the half level of a lightly blurred silhouette so that staircases vanish.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from hat_ros.array_types import Bool, Float, Float32

# Columns of a contour table.
CONTOUR_COLUMNS = 10
COL_X, COL_Y, COL_Z, COL_U, COL_V, COL_NU, COL_NV, COL_WEIGHT, COL_INSIDE, COL_OUTSIDE = range(CONTOUR_COLUMNS)
# How far, in crop pixels, the free distance along a normal is followed.
MAX_FREE_PX = 24
# Blur that turns a binary silhouette into one whose half level is smooth, in crop pixels.
_SMOOTHING_PX = 1.2


def contour_table(depth_m: Float32, silhouette: Bool, K_crop: Float, max_points: int) -> Float:
    """Points on the outline of a rendered crop.

    Args:
        depth_m: (h, w) depth along the optical axis in metres, any value where nothing is hit.
        silhouette: (h, w) bool, where something is hit.
        K_crop: (3, 3) intrinsics of the crop.
        max_points: at most this many, taken evenly in raster order.

    Returns:
        (N, 10) per point: camera-frame position in metres; crop pixel; outward unit normal in the image; weight (its
        share of contour length, pixels); free distance in crop pixels inwards and outwards, at most 24. Contour on
        the crop's own border is left out.
    """
    blurred = np.asarray(cv2.GaussianBlur(silhouette.astype(np.float32), (0, 0), _SMOOTHING_PX), np.float32)
    return _contour_table(np.ascontiguousarray(depth_m), silhouette, blurred, K_crop, max_points)


@njit(cache=True, nogil=True)
def _count_cracks(silhouette: Bool) -> int:
    h, w = silhouette.shape
    count = 0
    for y in range(1, h - 1):
        for x in range(1, w - 1):
            if silhouette[y, x]:
                count += not silhouette[y, x + 1]
                count += not silhouette[y, x - 1]
                count += not silhouette[y + 1, x]
                count += not silhouette[y - 1, x]
    return count


@njit(cache=True, nogil=True)
def _free_distance(silhouette: Bool, u: float, v: float, du: float, dv: float, inside: bool) -> int:
    """Steps of one pixel along (du, dv) that stay inside (or outside) the silhouette."""
    h, w = silhouette.shape
    for step in range(1, MAX_FREE_PX + 1):
        x = int(np.floor(u + (step - 0.5) * du + 0.5))
        y = int(np.floor(v + (step - 0.5) * dv + 0.5))
        if x < 0 or y < 0 or x >= w or y >= h:
            return 0 if inside else MAX_FREE_PX
        if silhouette[y, x] != inside:
            return step - 1
    return MAX_FREE_PX


@njit(cache=True, nogil=True)
def _contour_table(
    depth_m: Float32,
    silhouette: Bool,
    blurred: Float32,
    K: Float,
    max_points: int,
) -> Float:
    h, w = silhouette.shape
    total = _count_cracks(silhouette)
    stride = max(1, (total + max_points - 1) // max_points)
    table = np.empty((total // stride + 1, CONTOUR_COLUMNS))
    count, seen = 0, 0
    for y in range(1, h - 1):
        for x in range(1, w - 1):
            if not silhouette[y, x]:
                continue
            for side in range(4):
                ox = 1 if side == 0 else (-1 if side == 1 else 0)
                oy = 1 if side == 2 else (-1 if side == 3 else 0)
                if silhouette[y + oy, x + ox]:
                    continue
                seen += 1
                if (seen - 1) % stride:
                    continue
                # Gradient of the blurred silhouette, averaged over the two pixels that share the edge.
                gx, gy = 0.0, 0.0
                for k in range(2):
                    px = min(max(x + k * ox, 1), w - 2)
                    py = min(max(y + k * oy, 1), h - 2)
                    gx += 0.25 * (blurred[py, px + 1] - blurred[py, px - 1])
                    gy += 0.25 * (blurred[py + 1, px] - blurred[py - 1, px])
                slope = np.sqrt(gx * gx + gy * gy)
                if slope < 1e-3:
                    continue
                nu, nv = -gx / slope, -gy / slope
                level = 0.5 * (blurred[y, x] + blurred[y + oy, x + ox])
                shift = min(max((level - 0.5) / slope, -0.5), 0.5)
                u = x + 0.5 * ox + shift * nu
                v = y + 0.5 * oy + shift * nv
                facing = nu * ox + nv * oy
                if facing <= 0.05:
                    continue
                z = depth_m[y, x]
                table[count, COL_X] = (u - K[0, 2]) / K[0, 0] * z
                table[count, COL_Y] = (v - K[1, 2]) / K[1, 1] * z
                table[count, COL_Z] = z
                table[count, COL_U] = u
                table[count, COL_V] = v
                table[count, COL_NU] = nu
                table[count, COL_NV] = nv
                table[count, COL_WEIGHT] = facing * stride
                table[count, COL_INSIDE] = _free_distance(silhouette, u, v, -nu, -nv, True)
                table[count, COL_OUTSIDE] = _free_distance(silhouette, u, v, nu, nv, False)
                count += 1
    return table[:count]
