"""Frames under way: credits come back with the statuses, and a frame that is overdue gives all of them back."""

from __future__ import annotations

import time

import pytest

from hat_ros.config import config_from_dict
from hat_ros.errors import StageTimeoutError
from hat_ros.ros.flights import Flights
from hat_ros.ros.timeouts import HANGS

CONFIG = config_from_dict({"graph": {"credits_replay": 3, "stage_timeout_s": 30.0, "startup_timeout_s": 180.0}}).graph


@pytest.fixture
def clock(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


@pytest.mark.parametrize(("live", "credits"), [(False, 3), (True, 1)])
def test_credits(live, credits):
    flights = Flights(CONFIG, live)
    for stamp in range(1, credits + 1):
        assert flights.admission.has_credit
        assert flights.enter(stamp) == stamp - 1
    assert not flights.admission.has_credit
    assert not flights.leave(99)
    assert flights.leave(1)
    assert flights.admission.has_credit
    assert flights.admitted == credits


def test_the_first_frame_may_take_longer(clock):
    flights = Flights(CONFIG, live=False)
    flights.enter(1)
    clock[0] += 100.0
    assert flights.overdue() is None
    flights.leave(1)
    flights.enter(2)
    flights.enter(3)
    clock[0] += 29.0
    assert flights.overdue() is None
    clock[0] += 2.0
    error = flights.overdue()
    assert isinstance(error, StageTimeoutError)
    assert str(error).startswith("no status for frame 2 within 30 s (raise graph.stage_timeout_s")
    assert str(error).endswith(HANGS)
    assert flights.admission.in_flight == ()
    assert flights.overdue() is None, "said once"
