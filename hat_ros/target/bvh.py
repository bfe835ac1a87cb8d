"""Ray casting in compiled code, for platforms without an ``embreex`` wheel: a bounding volume hierarchy of triangles.

Boxes are split at the median of the longest axis; triangles are met after Moeller and Trumbore, "Fast, Minimum Storage
Ray/Triangle Intersection", J. Graphics Tools 2 (1997). Double precision, so a hit may differ from Embree's where a ray
meets an edge to within single precision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hat_ros.array_types import Bool, Float, Float32, Int, Int32
from hat_ros.target.rays import Hits

_LEAF_SIZE = 4
# Boxes are this much larger than their triangles, as a share of the model's extent: rounding must not lose a hit.
_PADDING = 1e-12
# Each level halves the triangles: room for 2^60 of them.
_MAX_DEPTH = 64
# Reciprocal of a direction without a component along an axis.
_STEEP = 1e30


class _Tree(NamedTuple):
    """Nodes in depth-first order; the first child of a node follows it.

    Attributes:
        low, high: (N, 3) corners of each node's box.
        second: (N,) second child of an inner node; -1 = leaf.
        start, stop: (N,) range of a leaf in ``order``.
        order: (F,) triangle indices.
    """

    low: Float
    high: Float
    second: Int
    start: Int
    stop: Int
    order: Int


class BvhCaster:
    """See :class:`hat_ros.target.rays.RayCaster`.

    Args:
        corners_m: (F, 3, 3) corners of the triangles, F > 0.
    """

    def __init__(self, corners_m: Float) -> None:
        self._corners_m = np.array(corners_m, dtype=np.float64, order="C")
        self._tree = _build(self._corners_m)

    def trace(self, origins_m: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
        """See the protocol."""
        return Hits(*_trace(self._tree, self._corners_m, *_rays(origins_m, directions), False))

    def occluded(self, origins_m: NDArray[np.floating], directions: NDArray[np.floating]) -> Bool:
        """See the protocol."""
        face, *_ = _trace(self._tree, self._corners_m, *_rays(origins_m, directions), True)
        return face >= 0


def _rays(origins_m: NDArray[np.floating], directions: NDArray[np.floating]) -> tuple[Float, Float]:
    return np.array(origins_m, dtype=np.float64, order="C"), np.array(directions, dtype=np.float64, order="C")


@njit(cache=True, nogil=True)
def _build(corners: Float) -> _Tree:
    n = len(corners)
    lowest, highest = np.empty((n, 3)), np.empty((n, 3))
    for f in range(n):
        for k in range(3):
            lowest[f, k] = min(corners[f, 0, k], corners[f, 1, k], corners[f, 2, k])
            highest[f, k] = max(corners[f, 0, k], corners[f, 1, k], corners[f, 2, k])
    middle = lowest + highest
    padding = _PADDING * (highest.max() - lowest.min())
    order = np.arange(n)
    low, high = np.empty((2 * n, 3)), np.empty((2 * n, 3))
    second, start, stop = np.full(2 * n, -1), np.empty(2 * n, np.int64), np.empty(2 * n, np.int64)
    # Ranges to make nodes of, and the parent that has each for its second child, -1 = none.
    todo = np.empty((_MAX_DEPTH, 3), np.int64)
    todo[0] = 0, n, -1
    n_todo, node = 1, 0
    while n_todo:
        n_todo -= 1
        a, b, parent = todo[n_todo]
        if parent >= 0:
            second[parent] = node
        inside = order[a:b]
        start[node], stop[node] = a, b
        axis, spread = 0, -1.0
        for k in range(3):
            low[node, k], high[node, k] = lowest[inside, k].min() - padding, highest[inside, k].max() + padding
            extent = middle[inside, k].max() - middle[inside, k].min()
            if extent > spread:
                axis, spread = k, extent
        if b - a > _LEAF_SIZE:
            order[a:b] = inside[np.argsort(middle[inside, axis], kind="mergesort")]
            half = (a + b) // 2
            todo[n_todo] = half, b, node
            todo[n_todo + 1] = a, half, -1
            n_todo += 2
        node += 1
    return _Tree(low[:node], high[:node], second[:node], start[:node], stop[:node], order)


@njit(cache=True, nogil=True)
def _enters(low: Float, high: Float, origin: Float, inverse: Float, limit: float) -> bool:
    """Whether a ray meets a box before the ray parameter ``limit``."""
    near, far = 0.0, limit
    for k in range(3):
        a, b = (low[k] - origin[k]) * inverse[k], (high[k] - origin[k]) * inverse[k]
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return near <= far


@njit(cache=True, nogil=True)
def _meet(triangle: Float, o: Float, d: Float) -> tuple[float, float, float]:
    """Ray parameter of a hit and weights of the second and third corner; the parameter is -1 on a miss."""
    ax, ay, az = triangle[0]
    e1x, e1y, e1z = triangle[1, 0] - ax, triangle[1, 1] - ay, triangle[1, 2] - az
    e2x, e2y, e2z = triangle[2, 0] - ax, triangle[2, 1] - ay, triangle[2, 2] - az
    px, py, pz = d[1] * e2z - d[2] * e2y, d[2] * e2x - d[0] * e2z, d[0] * e2y - d[1] * e2x
    determinant = e1x * px + e1y * py + e1z * pz
    if determinant == 0.0:
        return -1.0, 0.0, 0.0
    sx, sy, sz = o[0] - ax, o[1] - ay, o[2] - az
    u = (sx * px + sy * py + sz * pz) / determinant
    qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
    v = (d[0] * qx + d[1] * qy + d[2] * qz) / determinant
    if u < 0.0 or v < 0.0 or u + v > 1.0:
        return -1.0, 0.0, 0.0
    return (e2x * qx + e2y * qy + e2z * qz) / determinant, u, v


@njit(cache=True, nogil=True)
def _trace(
    tree: _Tree, corners: Float, origins: Float, directions: Float, any_hit: bool
) -> tuple[Int32, Float32, Float32, Float32]:
    """Nearest hits, or just any: face (-1 = miss), ray parameter and two weights of each ray (N,)."""
    n = len(origins)
    face, distance = np.full(n, -1, np.int32), np.full(n, np.inf, np.float32)
    weight_u, weight_v = np.zeros(n, np.float32), np.zeros(n, np.float32)
    todo, inverse = np.empty(_MAX_DEPTH, np.int64), np.empty(3)
    for i in range(n):
        o, d = origins[i], directions[i]
        for k in range(3):
            inverse[k] = 1.0 / d[k] if d[k] != 0.0 else _STEEP
        nearest = np.inf
        todo[0], n_todo = 0, 1
        while n_todo:
            n_todo -= 1
            node = todo[n_todo]
            if not _enters(tree.low[node], tree.high[node], o, inverse, nearest):
                continue
            if tree.second[node] >= 0:
                todo[n_todo], todo[n_todo + 1] = tree.second[node], node + 1
                n_todo += 2
                continue
            for f in tree.order[tree.start[node] : tree.stop[node]]:
                t, u, v = _meet(corners[f], o, d)
                if 0.0 <= t < nearest:
                    nearest, face[i], distance[i], weight_u[i], weight_v[i] = t, f, t, u, v
            if any_hit and face[i] >= 0:
                break
    return face, distance, weight_u, weight_v
