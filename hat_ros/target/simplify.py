"""Fewer triangles for the work: vertex clustering with quadric error metrics.

All vertices in one cell of a regular grid become one, at the place that lies nearest to the planes of the faces around
them, so that flat faces stay flat and edges and corners stay sharp. No vertex moves by more than a cell's diagonal.
Source: Lindstrom, Out-of-Core Simplification of Large Polygonal Models, SIGGRAPH 2000.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hat_ros.array_types import Bool, Float, Int
from hat_ros.target.model import area_vectors

# Beyond so many faces a model is simplified, to about the half.
MAX_WORK_FACES = 400_000
_GOAL_FACES = 200_000
_FIRST_CELLS, _FEWEST_CELLS = 512, 64
# Directions in which the faces of a cell say less than this share of the most say nothing: flat and straight parts.
_RANK_TOLERANCE = 1e-3
_BLOCK = 1 << 18


@dataclass(frozen=True, eq=False)
class Simplified:
    """Outcome of :func:`simplify`.

    Attributes:
        corners: (F, 3, 3) corners of the faces that are left.
        keep: (N,) bool which of the original faces they were; colours and textures go with them.
        cell: edge of a cell, in the unit of the corners.
    """

    corners: Float
    keep: Bool
    cell: float


def simplify(corners: Float, goal: int = _GOAL_FACES) -> Simplified:
    """Cluster the vertices of (N, 3, 3) triangles until at most ``goal`` faces are left, or the grid is coarse."""
    low = corners.min(axis=(0, 1))
    extent = float((corners.max(axis=(0, 1)) - low).max())
    cells = _FIRST_CELLS
    while True:
        cell = extent / cells
        ids = _cell_ids(corners, low, cell)
        keep = _faces_left(ids)
        count = int(keep.sum())
        if count <= goal or cells <= _FEWEST_CELLS:
            break
        # The number of faces of a surface goes with the square of the number of cells along a side.
        cells = max(_FEWEST_CELLS, int(cells * min(0.9, np.sqrt(goal / count) * 0.98)))
    places, index = _places(corners, ids, low, cell)
    return Simplified(places[index.reshape(-1, 3)[keep]], keep, cell)


def _cell_ids(corners: Float, low: Float, cell: float) -> Int:
    """(N, 3) number of the cell of each corner."""
    side = int(np.ceil((corners.max(axis=(0, 1)) - low).max() / cell)) + 2
    ids = np.empty(corners.shape[:2], np.int64)
    for start in range(0, len(corners), _BLOCK):
        block = ((corners[start : start + _BLOCK] - low) / cell).astype(np.int64)
        ids[start : start + _BLOCK] = (block[..., 0] * side + block[..., 1]) * side + block[..., 2]
    return ids


def _faces_left(ids: Int) -> Bool:
    """(N,) faces with three cells; of those with the same three, in the same sense, one."""
    a, b, c = ids.T
    keep = (a != b) & (b != c) & (c != a)
    left = np.flatnonzero(keep)
    first = ids[left].argmin(axis=1)
    turned = np.take_along_axis(ids[left], (first[:, None] + np.arange(3)) % 3, axis=1)
    _, unique = np.unique(turned, axis=0, return_index=True)
    keep[:] = False
    keep[left[unique]] = True
    return keep


def _places(corners: Float, ids: Int, low: Float, cell: float) -> tuple[Float, Int]:
    """(C, 3) place of each occupied cell's vertex, and (3 N,) which cell each corner is in."""
    occupied, index = np.unique(ids, return_inverse=True)
    index = index.reshape(-1)
    count = len(occupied)
    A, b, mean = np.zeros((count, 6)), np.zeros((count, 3)), np.zeros((count, 3))
    weight = np.bincount(index, minlength=count)
    upper = np.triu_indices(3)
    normal = area_vectors(corners)
    # Relative to the cell's own mean, which keeps the numbers small.
    points = corners.reshape(-1, 3)
    for axis in range(3):
        mean[:, axis] = np.bincount(index, points[:, axis], count) / weight
    for corner in range(3):
        at = index[corner::3]
        depth = np.einsum("nk,nk->n", normal, corners[:, corner] - mean[at])
        for axis in range(3):
            b[:, axis] += np.bincount(at, normal[:, axis] * depth, count)
        for slot, (row, column) in enumerate(zip(*upper, strict=True)):
            A[:, slot] += np.bincount(at, normal[:, row] * normal[:, column], count)
    full = np.zeros((count, 3, 3))
    full[:, upper[0], upper[1]] = A
    full[:, upper[1], upper[0]] = A
    values, vectors = np.linalg.eigh(full)
    strong = values > _RANK_TOLERANCE * values[:, -1:]
    inverse = np.where(strong, 1.0 / np.where(strong, values, 1.0), 0.0)
    step = np.einsum("nik,nk,njk,nj->ni", vectors, inverse, vectors, b)
    # A vertex that would leave its cell stays where its cell's are on average.
    step[np.abs(step).max(axis=1) > cell] = 0.0
    return mean + step, index
