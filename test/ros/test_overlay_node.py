"""The overlay costs something only while it is watched."""

from __future__ import annotations

import numpy as np
import rclpy
from single_node import add, spin_until

from hat_ros.io import images, messages, topics
from hat_ros.ros import qos
from hat_ros.ros.overlay_node import OverlayNode
from hat_ros.types import Camera, Estimate, TrackState


def test_the_overlay_is_drawn_while_it_is_watched_and_images_come_only_then(executor, model):
    node = add(executor, OverlayNode, target=str(model))
    node.start()
    assert not node.endpoints.has_input(topics.FRAME)
    viewer = rclpy.create_node("viewer", context=executor.context)
    executor.add_node(viewer)
    seen = []

    def publisher(topic):
        return viewer.create_publisher(messages.message_class(topics.TYPES[topic]), topic, qos.profile_of(topic))

    send = {topic: publisher(topic) for topic in (topics.HAT_CAMERA_INFO, topics.FRAME, topics.STATUS)}
    subscription = viewer.create_subscription(
        messages.message_class(topics.TYPES[topics.OVERLAY]), topics.OVERLAY, seen.append, qos.DEBUG
    )
    assert spin_until(executor, lambda: node.endpoints.has_input(topics.FRAME), turns=400)
    assert spin_until(executor, lambda: all(p.get_subscription_count() for p in send.values()))
    make, camera = messages.Wire.ros(), Camera(np.array([[100.0, 0, 31.5], [0, 100, 23.5], [0, 0, 1]]), 64, 48)
    estimate = Estimate(7, TrackState.TRACKING, np.array([0, 0, 9.0, 0, 0, 0, 1]), np.eye(6))
    send[topics.HAT_CAMERA_INFO].publish(make.camera_info(7, "c", camera))
    send[topics.FRAME].publish(make.frame(7, "c", np.zeros((48, 64, 3), np.uint8), None))
    spin_until(executor, lambda: False, turns=20)
    send[topics.STATUS].publish(make.status("c", estimate, messages.Admitted(0, 0, 0)))
    assert spin_until(executor, lambda: seen)
    drawn = images.decode_image(seen[0])[0]
    assert drawn.shape == (48, 64, 3)
    assert drawn.max() > 100
    assert seen[0].header.frame_id == "c"
    viewer.destroy_subscription(subscription)
    assert spin_until(executor, lambda: not node.endpoints.has_input(topics.FRAME), turns=400)
    viewer.destroy_node()
