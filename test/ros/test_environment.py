"""What is settled before the first DDS participant exists."""

from __future__ import annotations

import os

import cv2
import pytest

from hat_ros.ros.environment import (
    OPENCV_THREADS,
    PROFILE,
    RANGE,
    leave_cores_to_stages,
    prepare_environment,
    profile_path,
    replay_environment,
)


def test_profile_fits_the_shared_memory_there_is(monkeypatch, tmp_path):
    assert profile_path(tmp_path / "none").name == "fastdds_small.xml"
    space = os.statvfs_result((4096, 4096, 2**24, 2**24, 2**24, 0, 0, 0, 0, 255))
    monkeypatch.setattr(os, "statvfs", lambda _: space)
    assert "<segment_size>67108864<" in profile_path().read_text()


def test_environment_defaults_leave_the_user_alone(monkeypatch):
    monkeypatch.delenv(PROFILE, raising=False)
    monkeypatch.delenv(RANGE, raising=False)
    prepare_environment()
    assert os.environ[PROFILE] == str(profile_path())
    assert RANGE not in os.environ, "a live graph is found from other machines, as its user has set it"
    monkeypatch.setenv(PROFILE, "/mine.xml")
    prepare_environment()
    assert os.environ[PROFILE] == "/mine.xml"


@pytest.mark.parametrize("given", [None, "SUBNET"])
def test_a_replay_keeps_to_itself_and_leaves_the_environment_as_it_was(monkeypatch, given):
    monkeypatch.delenv(PROFILE, raising=False)
    monkeypatch.delenv(RANGE, raising=False)
    if given:
        monkeypatch.setenv(RANGE, given)
    before = dict(os.environ)
    with replay_environment():
        assert os.environ[PROFILE] == str(profile_path())
        assert os.environ[RANGE] == (given or "LOCALHOST")
    assert dict(os.environ) == before


def test_nodes_keep_opencv_to_one_thread_unless_the_user_says_otherwise(monkeypatch):
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(2)
        monkeypatch.setenv(OPENCV_THREADS, "2")
        leave_cores_to_stages()
        assert cv2.getNumThreads() == 2
        monkeypatch.delenv(OPENCV_THREADS)
        leave_cores_to_stages()
        assert cv2.getNumThreads() == 1
    finally:
        cv2.setNumThreads(before)
