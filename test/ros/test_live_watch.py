"""Figures of a live run, from what arrived and when."""

from __future__ import annotations

import pytest

from hat_ros.ros.live_watch import Moment, Watched


@pytest.fixture
def watched():
    poses = [(10.0, 100), (10.1, 200), (13.0, 300), (13.1, 250), (13.2, 400)]
    statuses = [(arrived, 0.01 * n, stamp, 1) for n, (arrived, stamp) in enumerate(poses)]
    return Watched(statuses=statuses, poses=poses)


def test_only_a_pose_of_a_later_image_ends_the_wait(watched):
    assert watched.first_pose_since(Moment(10.05, 250)) == pytest.approx(2.95)
    assert watched.first_pose_since(Moment(10.05, 400)) is None


def test_the_longest_gap_counts_from_the_first_moment_to_the_last(watched):
    assert watched.longest_gap(10.0, 13.2) == pytest.approx(2.9)
    assert watched.longest_gap(13.05, 20.0) == pytest.approx(6.8)
    assert watched.longest_gap(30.0, 31.0) == pytest.approx(1.0)


def test_counts_and_latencies(watched):
    assert watched.n_poses(10.05, 13.1) == 3
    assert watched.n_out_of_order() == 1
    assert watched.latency_ms(10.05, 13.05).tolist() == pytest.approx([10.0, 20.0])
