"""A silhouette with a third of the rays: every second pixel, then all pixels near the outline found. Compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hat_ros.array_types import Bool, Float, Float32, Int32
from hat_ros.target.rays import Hits, RayCaster

# Origins in metres and directions of N rays, (N, 3) each.
Rays = tuple[Float32, Float32]


class SeenSilhouette(NamedTuple):
    """A silhouette with its depth near the outline, and the rays that found it.

    Attributes:
        mask: (h, w) bool.
        depth_m: (h, w) float32, set at every second pixel and near the outline.
        grid: rays through every second pixel, row by row, and their hits.
        x: (N,) and y: (N,) of the other pixels that were asked.
        scattered: the rays through these, and their hits.
    """

    mask: Bool
    depth_m: Float32
    grid: tuple[Rays, Hits]
    x: Int32
    y: Int32
    scattered: tuple[Rays, Hits]


def cast_silhouette(caster: RayCaster, width: int, height: int, to_ray: Float, origin: Float) -> SeenSilhouette:
    """Silhouette on a crop of even size with a third of the rays; a speck between the grid's rays is lost.

    Args:
        caster: of the target.
        width, height: of the crop, pixels.
        to_ray, origin: see :func:`grid_rays`.
    """
    rays = grid_rays(width, height, to_ray, origin)
    hits = caster.trace(*rays)
    mask, depth_m, x, y = spread_grid(hits.face, hits.distance, width, height)
    near = scattered_rays(x, y, to_ray, origin)
    near_hits = caster.trace(*near)
    place_pixels(mask, depth_m, x, y, near_hits.face, near_hits.distance)
    return SeenSilhouette(mask, depth_m, (rays, hits), x, y, (near, near_hits))


@njit(cache=True, nogil=True)
def grid_rays(width: int, height: int, to_ray: Float, origin: Float) -> Rays:
    """Origins and directions (N, 3) of the rays through every second pixel of a crop of even size, row by row.

    Args:
        width, height: of the crop, pixels.
        to_ray: (3, 3) rows a, b, c of the direction ``x a + y b + c`` through pixel (x, y).
        origin: (3,) of all rays.
    """
    n = (width // 2) * (height // 2)
    origins, directions = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
    i = 0
    for y in range(0, height, 2):
        for x in range(0, width, 2):
            for axis in range(3):
                directions[i, axis] = x * to_ray[0, axis] + y * to_ray[1, axis] + to_ray[2, axis]
                origins[i, axis] = origin[axis]
            i += 1
    return origins, directions


@njit(cache=True, nogil=True)
def scattered_rays(x: Int32, y: Int32, to_ray: NDArray, origin: NDArray) -> Rays:
    """The same through given pixels (N,), (N,)."""
    origins, directions = np.empty((len(x), 3), np.float32), np.empty((len(x), 3), np.float32)
    for i in range(len(x)):
        for axis in range(3):
            directions[i, axis] = x[i] * to_ray[0, axis] + y[i] * to_ray[1, axis] + to_ray[2, axis]
            origins[i, axis] = origin[axis]
    return origins, directions


@njit(cache=True, nogil=True)
def spread_grid(face: Int32, distance: Float32, width: int, height: int) -> tuple[Bool, Float32, Int32, Int32]:
    """What the grid's rays hit, on the whole crop, and which pixels remain to be asked.

    Args:
        face: (N,) face that each grid ray hit, -1 = none.
        distance: (N,) ray parameter, the depth.
        width, height: of the crop.

    Returns:
        mask (h, w), each ray standing for its 2 x 2 pixels; depth (h, w) float32, set at the grid's pixels; and x, y
        of the other pixels of those blocks that have both hits and misses around them. Off the crop nothing is hit.
    """
    rows, cols = height // 2, width // 2
    mask, depth = np.empty((height, width), np.bool_), np.zeros((height, width), np.float32)
    x_todo, y_todo = np.empty(3 * rows * cols, np.int32), np.empty(3 * rows * cols, np.int32)
    n = 0
    for r in range(rows):
        for c in range(cols):
            hit = face[r * cols + c] >= 0
            mask[2 * r, 2 * c] = mask[2 * r, 2 * c + 1] = mask[2 * r + 1, 2 * c] = mask[2 * r + 1, 2 * c + 1] = hit
            depth[2 * r, 2 * c] = distance[r * cols + c]
            any_hit, any_miss = hit, not hit
            for k in range(max(r - 1, 0), min(r + 2, rows)):
                for m in range(max(c - 1, 0), min(c + 2, cols)):
                    if face[k * cols + m] >= 0:
                        any_hit = True
                    else:
                        any_miss = True
            at_border = r == 0 or c == 0 or r == rows - 1 or c == cols - 1
            if any_hit and (any_miss or at_border):
                for k, m in ((0, 1), (1, 0), (1, 1)):
                    y_todo[n], x_todo[n] = 2 * r + k, 2 * c + m
                    n += 1
    return mask, depth, x_todo[:n], y_todo[:n]


@njit(cache=True, nogil=True)
def place_pixels(
    mask: Bool,
    depth: Float32,
    x: Int32,
    y: Int32,
    face: Int32,
    distance: Float32,
) -> None:
    """Write what the rays through single pixels hit."""
    for i in range(len(x)):
        mask[y[i], x[i]] = face[i] >= 0
        depth[y[i], x[i]] = distance[i]
