"""A live graph whose camera steps back in time, as ``ros2 bag play --loop`` does."""

from __future__ import annotations

import numpy as np
import pytest
from live_nodes import KINDS, WIRE, Camera, parameters
from single_node import add, spin_until

from hat_ros.core.sync import RESTART_FRAMES
from hat_ros.io import messages
from hat_ros.io.bag_reader import BagReader
from hat_ros.target.loading import load_target
from hat_ros.tracker import HatTracker

PASSED = RESTART_FRAMES - 1


@pytest.mark.graph
def test_stamps_that_step_back_begin_a_new_epoch_in_every_stage(executor, clean_bag, config):
    frames = list(BagReader(clean_bag).frames())
    nodes = [add(executor, kind, **parameters(clean_bag)) for kind in KINDS.values()]
    for node in nodes:
        node.start()
    entrance, camera = nodes[0], Camera(executor)
    assert spin_until(executor, lambda: not entrance.endpoints.unmatched() and camera.image.get_subscription_count())
    assert spin_until(executor, camera.info.get_subscription_count)
    camera.info.publish(WIRE.camera_info(frames[0].stamp_ns, "cam", frames[0].camera))
    reported = []
    report = entrance.diagnostics.report
    entrance.diagnostics.report = lambda level, text: (reported.append(text), report(level, text))[1]

    for index, frame in enumerate(frames):
        camera.send(frame, lambda index=index: len(camera.statuses) == index + 1)
    camera.send(frames[3], lambda: entrance.values()["refused"] == 1)  # late, alone: no new epoch
    n = len(frames)
    for index, frame in enumerate(frames[:PASSED]):
        camera.send(frame, lambda index=index: entrance.values()["refused"] == 2 + index)
    for index, frame in enumerate(frames[PASSED:]):
        camera.send(frame, lambda index=index: len(camera.statuses) == n + index + 1)

    tracker = HatTracker(config, load_target(clean_bag / "target.yaml"))
    expected = [tracker.step(frame).estimate for frame in frames]
    tracker.reset()
    expected += [tracker.step(frame).estimate for frame in frames[PASSED:]]
    found = [messages.status_from(message) for message in camera.statuses]
    assert [status.estimate.stamp_ns for status in found] == [estimate.stamp_ns for estimate in expected]
    for status, estimate in zip(found, expected, strict=True):
        assert status.estimate.state == estimate.state
        assert np.array_equal(status.estimate.pose_row, estimate.pose_row, equal_nan=True)
    posed = [estimate.stamp_ns for estimate in expected if estimate.state.has_pose]
    assert spin_until(executor, lambda: len(camera.poses) == len(posed)), "each pose once"
    assert [messages.stamp_of(message) for message in camera.poses] == posed
    assert found[n].estimate.slam_epoch > found[n - 1].estimate.slam_epoch
    stepped = [text for text in reported if "steps back" in text]
    assert len(stepped) == 1
    assert stepped[0].startswith(
        f"header.stamp steps back from {frames[-1].stamp_ns} ns to {frames[PASSED].stamp_ns} ns, "
    )
    assert [node.failure for node in nodes] == [None] * 5
    assert [node.values()["late"] for node in nodes[1:]] == [0] * 4
    camera.node.destroy_node()
