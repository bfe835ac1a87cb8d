"""How long a graph may take: the first frame has longer, and progress is what counts."""

from __future__ import annotations

import time

import pytest

from hat_ros.config import config_from_dict
from hat_ros.errors import StageTimeoutError
from hat_ros.ros.timeouts import answer_limit, check_progress


def test_the_first_frame_has_the_longer_of_two_limits():
    limits = {"stage_timeout_s": 30.0, "startup_timeout_s": 180.0}
    config = config_from_dict({"graph": limits}).graph
    assert answer_limit(config, first=True) == (180.0, "graph.startup_timeout_s")
    assert answer_limit(config, first=False) == (30.0, "graph.stage_timeout_s")
    slow = config_from_dict({"graph": {**limits, "stage_timeout_s": 900.0}}).graph
    assert answer_limit(slow, first=True) == (900.0, "graph.stage_timeout_s")


def test_live_each_frame_given_up_doubles_the_limit():
    config = config_from_dict({"graph": {"live_timeout_s": 1.0, "stage_timeout_s": 30.0, "startup_timeout_s": 180.0}})
    limits = [answer_limit(config.graph, first=False, given_up=n) for n in (0, 1, 2, 5, 100_000)]
    assert [limit for limit, _ in limits] == [1.0, 2.0, 4.0, 30.0, 30.0]
    assert {option for _, option in limits} == {"graph.live_timeout_s"}
    assert answer_limit(config.graph, first=True, given_up=0) == (180.0, "graph.startup_timeout_s")


def test_only_too_long_without_progress_is_an_error():
    check_progress(time.monotonic() - 1.0, 2.0, "nothing came", "graph.stage_timeout_s")
    with pytest.raises(StageTimeoutError, match=r"nothing came within 2 s \(raise graph\.stage_timeout_s"):
        check_progress(time.monotonic() - 3.0, 2.0, "nothing came", "graph.stage_timeout_s")
