"""The camera of the test bench sends what its bag holds, stamped anew."""

from __future__ import annotations

import time

import numpy as np
import pytest
import rclpy
from single_node import add, spin_until

from hat_ros.errors import ConfigError
from hat_ros.io import messages, topics
from hat_ros.io.bag_reader import BagReader
from hat_ros.ros import qos
from hat_ros.ros.camera_node import CameraNode

pytestmark = pytest.mark.graph


def test_images_and_calibration_come_with_stamps_of_now(executor, clean_bag):
    listener = rclpy.create_node("listener", context=executor.context)
    executor.add_node(listener)
    heard = {topics.IMAGE: [], topics.CAMERA_INFO: []}
    for topic, out in heard.items():
        kind = messages.message_class(topics.TYPES[topic])
        listener.create_subscription(kind, topic, out.append, qos.IN_REPLAY)
    began_ns = time.time_ns()
    camera = add(executor, CameraNode, bag=str(clean_bag), rate_hz=50.0, n_sent=12, depth=16, exit_at_end=True)
    camera.trigger_configure()
    assert spin_until(executor, lambda: all(p.get_subscription_count() for p, _ in camera.endpoints._outputs.values()))
    camera.trigger_activate()
    assert spin_until(executor, lambda: camera.finished and {*map(len, heard.values())} == {12}, turns=1000)
    assert camera.values() == {"sent": 12}
    frames = list(BagReader(clean_bag).frames())
    stamps = [messages.stamp_of(message) for message in heard[topics.IMAGE]]
    assert [messages.stamp_of(message) for message in heard[topics.CAMERA_INFO]] == stamps
    assert set(np.diff(stamps)) == {20_000_000}
    assert began_ns < stamps[0] <= time.time_ns()
    for message, frame in zip(heard[topics.IMAGE], frames, strict=False):
        assert np.array_equal(np.frombuffer(message.data, np.uint8), frame.rgb.ravel())
    assert messages.camera_from(heard[topics.CAMERA_INFO][0]).K.tolist() == frames[0].camera.K.tolist()
    listener.destroy_node()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"bag": ""}, "'bag' is empty"),
        ({"reliability": "sure"}, "reliability is one of"),
        ({"transport": "h264"}, "h264"),
    ],
)
def test_bad_parameters_are_one_sentence(executor, clean_bag, changes, sentence):
    camera = add(executor, CameraNode, **{"bag": str(clean_bag), **changes})
    camera.start()
    assert isinstance(camera.failure, ConfigError)
    assert sentence in str(camera.failure)
