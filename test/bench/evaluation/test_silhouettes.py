"""Detected silhouettes are judged after a run by what was recorded."""

from types import SimpleNamespace

import numpy as np
import pytest

from hat_ros.bench.evaluation.silhouettes import Silhouettes
from hat_ros.types import Detection


def remembered(*masks):
    silhouettes = Silhouettes()
    for stamp, mask in enumerate(masks, 1):
        detection = None if mask is None else Detection(mask)
        silhouettes.remember(SimpleNamespace(detection=detection, estimate=SimpleNamespace(stamp_ns=stamp)))
    return silhouettes


def block(rows):
    mask = np.zeros((7, 9), bool)
    mask[:rows] = True
    return mask


def recorded(rows, value=255):
    return block(rows) * np.uint8(value)


def test_overlap_is_that_of_the_masks_and_a_missed_target_has_none():
    silhouettes = remembered(block(4), block(4), None)
    found = silhouettes.overlaps([(1, recorded(4)), (2, recorded(5)), (3, recorded(2))])
    assert found == {1: 1.0, 2: pytest.approx(4 / 5), 3: 0.0}


def test_boxes_empty_masks_and_frames_not_looked_at_are_not_judged():
    silhouettes = remembered(block(4), block(4), block(4))
    assert silhouettes.overlaps([(1, recorded(4, 128)), (2, recorded(0)), (3, None), (4, recorded(4))]) == {}


def test_the_first_of_two_frames_with_one_stamp_counts():
    assert remembered(block(4)).overlaps([(1, recorded(4)), (1, recorded(5))]) == {1: 1.0}
