"""A live graph whose camera steps back in time, as ``ros2 bag play --loop`` does."""

from __future__ import annotations

import numpy as np
import pytest
import rclpy
from graph_clip import CONFIG_OVERRIDES
from single_node import add, spin_until

from hat_ros.core.sync import RESTART_FRAMES
from hat_ros.io import messages, topics
from hat_ros.io.bag_reader import BagReader
from hat_ros.ros import qos
from hat_ros.ros.fusion_node import FusionNode
from hat_ros.ros.hypotheses_node import HypothesesNode
from hat_ros.ros.segmentation_node import SegmentationNode
from hat_ros.ros.selector_node import SelectorNode
from hat_ros.ros.slam_node import SlamNode
from hat_ros.target.loading import load_target
from hat_ros.tracker import HatTracker

WIRE = messages.Wire.ros()
PASSED = RESTART_FRAMES - 1


def parameters(bag):
    pairs = dict(item.split("=") for item in CONFIG_OVERRIDES)
    return {name: int(value) for name, value in pairs.items()} | {"target": str(bag / "target.yaml"), "live": True}


class Camera:
    """Sends frame by frame; the next one only after the answer to the one before."""

    def __init__(self, executor):
        self.executor, self.node = executor, rclpy.create_node("camera", context=executor.context)
        executor.add_node(self.node)
        self.statuses, self.poses = [], []
        make = self.node.create_publisher
        self.image = make(messages.message_class(topics.TYPES[topics.IMAGE]), topics.IMAGE, qos.IN_REPLAY)
        self.info = make(messages.message_class(topics.TYPES[topics.CAMERA_INFO]), topics.CAMERA_INFO, qos.IN_REPLAY)
        for topic, out in ((topics.STATUS, self.statuses), (topics.TARGET_POSE, self.poses)):
            kind, profile = messages.message_class(topics.TYPES[topic]), qos.profile_of(topic)
            self.node.create_subscription(kind, topic, out.append, profile)

    def send(self, frame, done):
        self.image.publish(WIRE.image(frame.stamp_ns, "cam", "rgb8", frame.rgb))
        assert spin_until(self.executor, done, turns=3000)


@pytest.mark.graph
def test_stamps_that_step_back_begin_a_new_epoch_in_every_stage(executor, clean_bag, config):
    frames = list(BagReader(clean_bag).frames())
    kinds = (SegmentationNode, HypothesesNode, SlamNode, SelectorNode, FusionNode)
    nodes = [add(executor, kind, **parameters(clean_bag)) for kind in kinds]
    for node in nodes:
        node.start()
    entrance, camera = nodes[0], Camera(executor)
    assert spin_until(executor, lambda: not entrance.endpoints.unmatched() and camera.image.get_subscription_count())
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
