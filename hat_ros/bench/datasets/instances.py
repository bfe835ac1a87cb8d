"""Several instances of one object in a BOP scene: which entry of which image is which of them.

The entries of ``scene_gt.json`` stand in no order that means anything, so they are followed from image to image by
where they are.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from hat_ros.array_types import Float
from hat_ros.errors import DatasetError

# An instance moves from image to image by at most this share of its distance to the nearest other one.
_MAX_MOVE = 0.5


def follow_instances(places: Mapping[int, Mapping[int, Float]], where: str) -> list[dict[int, int]]:
    """One mapping per instance, image number -> index of its entry; the instances in the order of their first image.

    Args:
        places: image number -> index of the entry -> (3,) position in the camera frame, of one object.
        where: for the error.

    Raises:
        DatasetError: they move too far from image to image to be told apart.
    """
    chains: list[dict[int, int]] = []
    last: list[Float] = []
    for number in sorted(places):
        indices = sorted(places[number])
        points = np.array([places[number][index] for index in indices]).reshape(-1, 3)
        moves = cdist(np.array(last).reshape(-1, 3), points)
        rows, columns = linear_sum_assignment(moves)
        for row, column in zip(rows, columns, strict=True):
            others = np.delete(np.linalg.norm(points - points[column], axis=1), column)
            others = np.concatenate([others, np.delete(np.linalg.norm(np.array(last) - last[row], axis=1), row)])
            if others.size and moves[row, column] > _MAX_MOVE * others.min():
                raise DatasetError(
                    f"{where}, image {number}: several instances of one object, and one of them moves by "
                    f"{moves[row, column]:.3g} m where another is {others.min():.3g} m away, so they cannot be told "
                    f"apart: leave one of them in scene_gt.json"
                )
            chains[row][number], last[row] = indices[column], points[column]
        for column in sorted(set(range(len(indices))) - set(columns.tolist())):
            chains.append({number: indices[column]})
            last.append(points[column])
    return chains
