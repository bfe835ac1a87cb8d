"""The pace of a replay: as many images under way as allowed; live, by the recording's clock."""

from __future__ import annotations

import time

import numpy as np
import pytest
from recording import N, stamp, write

from hat_ros.config import config_from_dict
from hat_ros.errors import StageTimeoutError
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.messages import Status
from hat_ros.ros.playback import Playback
from hat_ros.types import Estimate, TrackState

CONFIG = config_from_dict({"graph": {"credits_replay": 1, "stage_timeout_s": 30.0, "startup_timeout_s": 180.0}}).graph


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return BagReader(write(tmp_path_factory.mktemp("bag") / "bag"))


@pytest.fixture
def clock(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def playback(bag, live=False, rate=1.0, first_frame=0, max_frames=0):
    return Playback(bag, CONFIG, live=live, rate=rate, first_frame=first_frame, max_frames=max_frames)


def answer(player, index, dropped=0):
    estimate = Estimate(stamp(index), TrackState.LOST, np.full(7, np.nan), np.full((6, 6), np.nan))
    player.note_status(Status(estimate, index, dropped, 0))


def take_all(player):
    out = []
    while (packet := player.take()) is not None:
        out.append(packet.stamp_ns)
    return out


def test_a_replay_keeps_its_window_full_and_ends_when_all_is_answered(bag, clock):
    player = playback(bag)
    assert take_all(player) == [stamp(0), stamp(1), stamp(2)], "credits and two more that wait at the entrance"
    clock[0] += 0.25
    answer(player, 0)
    assert take_all(player) == [stamp(3)]
    for index in range(1, N):
        answer(player, index)
        take_all(player)
    assert player.is_done()
    assert (player.sent, player.answered, player.total) == (N, N, N)
    assert player.latency_s[0] == pytest.approx(0.25)


def test_refused_images_are_accounted_for(bag):
    player = playback(bag, max_frames=3)
    take_all(player)
    answer(player, 0)
    answer(player, 2, dropped=1)
    assert player.outstanding == 0
    assert player.is_done()


def test_first_frame_and_limit(bag):
    player = playback(bag, first_frame=2, max_frames=2)
    assert player.total == 2
    assert take_all(player) == [stamp(2), stamp(3)]
    assert playback(bag, first_frame=N + 5).total == 0


def test_live_goes_by_the_clock_once_the_first_frame_is_answered(bag, clock):
    player = playback(bag, live=True, rate=2.0)
    assert take_all(player) == [stamp(0)]
    clock[0] += 60.0  # however long that takes
    assert take_all(player) == []
    answer(player, 0)
    assert take_all(player) == [stamp(1)]
    clock[0] += 0.11  # two periods at twice the speed
    assert take_all(player) == [stamp(2), stamp(3)]
    assert not player.is_done()


def test_live_ends_when_the_last_image_is_answered_or_given_up(bag, clock):
    player = playback(bag, live=True, max_frames=2)
    player.take()
    answer(player, 0)
    player.take()
    assert not player.is_done()
    clock[0] += 31.0
    assert player.is_done()
    player.check_answers()  # live, a hanging stage is the graph's business


def test_a_graph_that_does_not_answer_is_noticed(bag, clock):
    player = playback(bag)
    take_all(player)
    clock[0] += 31.0
    player.check_answers()
    clock[0] += 150.0
    with pytest.raises(StageTimeoutError, match=r"frame 0 was not answered within 180 s \(raise graph\.startup"):
        player.check_answers()
