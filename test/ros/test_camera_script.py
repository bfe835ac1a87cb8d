"""When the camera of the test bench sends what."""

from __future__ import annotations

from itertools import islice, pairwise

import pytest

from hat_ros.errors import ConfigError
from hat_ros.ros.camera_script import CameraScript, ClockStep


def shots(n, **changes):
    return list(islice(CameraScript(**{"n_images": 4, "rate_hz": 10.0, **changes}).shots(), n))


def test_the_clip_goes_forth_and_back_at_the_rate():
    found = shots(8)
    assert [shot.index for shot in found] == [0, 1, 2, 3, 2, 1, 0, 1]
    assert [shot.offset_ns for shot in found] == [100_000_000 * n for n in range(8)]
    assert [shot.due_s for shot in found] == pytest.approx([0.1 * n for n in range(8)])
    assert [shot.index for shot in shots(3, n_images=1)] == [0, 0, 0]


def test_jitter_delays_but_keeps_order_and_exposure():
    found = shots(200, jitter_ms=250.0, seed=3)
    late = [shot.due_s - 1e-9 * shot.offset_ns for shot in found]
    assert min(late) >= -1e-9
    assert 0.2 < max(late) <= 0.35
    assert all(a.due_s <= b.due_s for a, b in pairwise(found))
    assert found == shots(200, jitter_ms=250.0, seed=3)
    assert found != shots(200, jitter_ms=250.0, seed=4)


def test_a_share_of_the_images_is_lost():
    found = shots(400, drop_share=0.5)
    assert 700 < found[-1].offset_ns / 100_000_000 < 900


def test_the_clock_steps_and_stays():
    steps = [ClockStep.parse("0.3:-60"), ClockStep.parse("0.5:60")]
    seconds = [1e-9 * shot.offset_ns for shot in shots(7, clock_steps=steps)]
    assert seconds == pytest.approx([0.0, 0.1, 0.2, -59.7, -59.6, 0.5, 0.6])


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [({"rate_hz": 0.0}, "rate_hz"), ({"drop_share": 1.5}, "drop_share"), ({"jitter_ms": -1.0}, "jitter_ms")],
)
def test_impossible_scripts_are_refused(changes, sentence):
    with pytest.raises(ConfigError, match=sentence):
        shots(1, **changes)


@pytest.mark.parametrize("text", ["4", "4:", "a:b", "1:2:3"])
def test_a_clock_step_is_two_numbers(text):
    with pytest.raises(ConfigError, match="expected AT:BY in seconds"):
        ClockStep.parse(text)
