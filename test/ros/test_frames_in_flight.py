"""Frames under way: credits come back with the statuses, and a frame that is overdue gives all of them back."""

from __future__ import annotations

import time

import pytest

from hat_ros.config import config_from_dict
from hat_ros.errors import StageTimeoutError
from hat_ros.ros.frames_in_flight import FramesInFlight
from hat_ros.ros.timeouts import HANGS

CONFIG = config_from_dict({"graph": {"credits_replay": 3, "stage_timeout_s": 30.0, "startup_timeout_s": 180.0}}).graph


@pytest.fixture
def clock(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


@pytest.mark.parametrize(("live", "credits"), [(False, 3), (True, 1)])
def test_credits(live, credits):
    frames = FramesInFlight(CONFIG, live)
    for stamp in range(1, credits + 1):
        assert frames.admission.has_credit
        assert frames.enter(stamp) == stamp - 1
    assert not frames.admission.has_credit
    assert not frames.leave(99)
    assert frames.leave(1)
    assert frames.admission.has_credit
    assert frames.admitted == credits


def test_the_first_frame_may_take_longer(clock):
    frames = FramesInFlight(CONFIG, live=False)
    frames.enter(1)
    clock[0] += 100.0
    assert frames.overdue() is None
    frames.leave(1)
    frames.enter(2)
    frames.enter(3)
    clock[0] += 29.0
    assert frames.overdue() is None
    clock[0] += 2.0
    error = frames.overdue()
    assert isinstance(error, StageTimeoutError)
    assert str(error).startswith("no status for frame 2 within 30 s (raise graph.stage_timeout_s")
    assert str(error).endswith(HANGS)
    assert frames.admission.in_flight == ()
    assert frames.overdue() is None, "reported once"
