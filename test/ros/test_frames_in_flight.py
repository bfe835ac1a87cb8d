"""Frames under way: credits come back with the statuses, and a frame that is overdue gives all of them back."""

from __future__ import annotations

import time

import pytest

from hat_ros.config import config_from_dict
from hat_ros.errors import StageTimeoutError
from hat_ros.ros.frames_in_flight import FramesInFlight
from hat_ros.ros.timeouts import HANGS

LIMITS = {"stage_timeout_s": 30.0, "startup_timeout_s": 180.0, "live_timeout_s": 1.0}
CONFIG = config_from_dict({"graph": {"credits_replay": 3, "credits_live": 2, **LIMITS}}).graph


@pytest.fixture
def clock(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


@pytest.mark.parametrize(("live", "credits"), [(False, 3), (True, 2)])
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


def test_live_a_late_frame_is_given_up_soon_and_later_each_time_in_a_row(clock):
    frames = FramesInFlight(CONFIG, live=True)
    frames.enter(1)
    frames.leave(1)
    for stamp, limit_s in ((2, 1.0), (3, 2.0), (4, 4.0)):
        frames.enter(stamp)
        clock[0] += limit_s
        assert frames.overdue() is None
        clock[0] += 0.1
        assert f"no status for frame {stamp} within {limit_s:g} s" in str(frames.overdue())
    assert not frames.leave(4), "its answer came too late to count"
    frames.enter(5)
    assert frames.leave(5)
    frames.enter(6)
    frames.enter(7)
    clock[0] += 1.1
    assert frames.overdue() is not None, "one in time, and the limit is the first again"
    assert frames.given_up == 5
