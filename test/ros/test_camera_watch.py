"""What is said of a camera that is silent or too fast."""

from __future__ import annotations

import math
import time

import pytest

from hat_ros.ros.camera_watch import OVERLOAD_PERIOD_S, CameraWatch
from hat_ros.ros.diagnostics import STALE, WARN


@pytest.fixture
def clock(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def test_a_silent_camera_is_a_warning_then_stale_and_its_age_is_said(clock):
    watch = CameraWatch()
    assert watch.silence() is None
    assert math.isnan(watch.age_s)
    for _ in range(3):
        clock[0] += 0.1
        watch.note_image()
    clock[0] += 0.9
    assert watch.silence() is None
    clock[0] += 0.3
    assert watch.silence() == (WARN, "no image for 1.2 s")
    clock[0] += 4.0
    assert watch.silence() == (STALE, "no image for 5.2 s")
    assert watch.is_silent
    watch.note_image()
    assert watch.silence() is None
    assert not watch.is_silent


def test_a_slow_camera_may_be_silent_for_longer(clock):
    watch = CameraWatch()
    for _ in range(3):
        clock[0] += 2.0
        watch.note_image()
    clock[0] += 5.9
    assert watch.silence() is None
    clock[0] += 0.2
    assert watch.silence()[0] == STALE


def test_overload_is_said_when_it_begins_and_when_it_ends(clock):
    watch, dropped, said = CameraWatch(), 0, []
    for second in range(40):
        for _ in range(30):
            watch.note_image()
        dropped += 6 if 10 <= second < 20 else 1
        clock[0] += OVERLOAD_PERIOD_S / 10
        said.append(watch.overload(dropped))
    assert [index for index, text in enumerate(said) if text] == [19, 29]
    assert said[19] == "60 of the last 300 images were dropped, in 10 s: the camera is faster than this machine"
    assert said[29].endswith("the graph keeps up again")
