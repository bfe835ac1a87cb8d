"""Anchor opportunities, counted in input frames."""

import pytest

from hat_ros.config import KeyframeConfig
from hat_ros.core.keyframes import KeyframeSchedule


def _published(gap_frames):
    return KeyframeSchedule(KeyframeConfig(gap_frames=gap_frames, settled_factor=1))


def _keyframes(gap, detections):
    schedule = _published(gap)
    return [i for i, found in enumerate(detections) if schedule.update(found)]


@pytest.mark.parametrize("gap", [1, 4, 6])
def test_a_steady_target_gives_a_fixed_cadence_from_the_first_frame(gap):
    assert _keyframes(gap, [True] * 20) == list(range(0, 20, gap))


def test_without_a_detection_the_opportunity_stays_open():
    detections = [True] * 4 + [False] * 3 + [True] * 6
    assert _keyframes(4, detections) == [0, 7, 11]
    assert _keyframes(4, [False] * 3 + [True] * 6) == [3, 7]


def test_a_reset_makes_the_next_detection_an_opportunity():
    schedule = _published(4)
    assert schedule.update(True)
    assert not schedule.update(True)
    schedule.reset()
    assert not schedule.update(False)
    assert schedule.update(True)


def test_a_settled_track_is_asked_less_often_until_it_is_in_doubt():
    schedule = KeyframeSchedule(KeyframeConfig(gap_frames=4, settled_factor=3))
    healthy = [2 <= i < 42 for i in range(60)]
    asked = [i for i in range(60) if schedule.update(True, healthy[i])]
    # Frame 0 is not healthy yet; 4, 8 and 12 settle it; doubt at 42 asks again at once, its gap being over.
    assert asked == [0, 4, 8, 12, 24, 36, 42, 46, 50, 54, 58]


def _asked(schedule, decided):
    out = []
    for i in range(20):
        if schedule.update(True):
            out.append(i)
            schedule.answered(decided)
    return out


def test_a_first_attempt_that_decided_nothing_is_soon_repeated():
    schedule = KeyframeSchedule(KeyframeConfig(gap_frames=6, settled_factor=3))
    assert _asked(schedule, decided=False) == [0, 2, 8, 14]
    schedule.reset()
    assert _asked(schedule, decided=True) == [0, 6, 12, 18]
    assert _asked(_published(6), decided=False) == [0, 6, 12, 18]


def test_health_changes_nothing_with_a_factor_of_one():
    schedule = _published(4)
    assert [i for i in range(20) if schedule.update(True, True)] == list(range(0, 20, 4))


def test_an_attempt_on_something_else_is_soon_repeated():
    schedule = KeyframeSchedule(KeyframeConfig(gap_frames=6, settled_factor=3))
    assert [i for i in range(20) if schedule.update(True, failed=i in (1, 2, 9, 10))] == [0, 2, 8, 10, 16]
    schedule = _published(6)
    assert [i for i in range(20) if schedule.update(True, failed=i > 0)] == [0, 6, 12, 18]


def test_frames_left_out_count_and_unsettle_the_track():
    schedule = KeyframeSchedule(KeyframeConfig(gap_frames=4, settled_factor=3))
    missed = {15: 2, 22: 1, 25: 6}
    asked = [i for i in range(36) if schedule.update(True, healthy=True, n_missed=missed.get(i, 0))]
    # Settled from 8 on: 12 frames to 18, 2 of them left out; after 6 more the next is due at once, the gap 4 again.
    assert asked == [0, 4, 8, 18, 25, 29, 33]


def test_frames_left_out_do_not_count_with_a_factor_of_one():
    schedule = _published(4)
    assert [i for i in range(10) if schedule.update(True, n_missed=3)] == [0, 4, 8]
