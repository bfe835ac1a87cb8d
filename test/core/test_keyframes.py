"""Anchor opportunities, counted in input frames."""

import pytest

from hat_ros.config import KeyframeConfig
from hat_ros.core.keyframes import KeyframeSchedule


def _keyframes(gap, detections):
    schedule = KeyframeSchedule(KeyframeConfig(gap_frames=gap))
    return [i for i, found in enumerate(detections) if schedule.update(found)]


@pytest.mark.parametrize("gap", [1, 4, 6])
def test_a_steady_target_gives_a_fixed_cadence_from_the_first_frame(gap):
    assert _keyframes(gap, [True] * 20) == list(range(0, 20, gap))


def test_without_a_detection_the_opportunity_stays_open():
    detections = [True] * 4 + [False] * 3 + [True] * 6
    assert _keyframes(4, detections) == [0, 7, 11]
    assert _keyframes(4, [False] * 3 + [True] * 6) == [3, 7]


def test_a_reset_makes_the_next_detection_an_opportunity():
    schedule = KeyframeSchedule(KeyframeConfig(gap_frames=4))
    assert schedule.update(True)
    assert not schedule.update(True)
    schedule.reset()
    assert not schedule.update(False)
    assert schedule.update(True)
