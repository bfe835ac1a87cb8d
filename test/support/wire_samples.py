"""Messages on their way through the middleware and through a bag, and what travels in them."""

from __future__ import annotations

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

from hat_ros.io import messages
from hat_ros.io.rosbag import TYPESTORE
from hat_ros.types import Candidates

STAMP = 1_700_000_000_123_456_789
ROS = messages.Wire.ros()
BAG = messages.Wire.bag(TYPESTORE)


def through_dds(message):
    """What a subscriber in another process gets."""
    return deserialize_message(serialize_message(message), type(message))


def through_bag(message):
    kind = message.__msgtype__
    return TYPESTORE.deserialize_cdr(bytes(TYPESTORE.serialize_cdr(message, kind)), kind)


def pose_rows(n, seed=0):
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(n, 4))
    return np.column_stack([rng.normal(size=(n, 3)), quat / np.linalg.norm(quat, axis=1, keepdims=True)])


def candidates(n=4, seed=0):
    rng = np.random.default_rng(seed)
    score = -np.sort(rng.normal(size=n))
    return Candidates(pose_rows(n, seed), score, np.array([1.5, 2.5, 30.25, 40.125]))


def same_bits(a, b):
    return np.asarray(a, dtype=np.float64).tobytes() == np.asarray(b, dtype=np.float64).tobytes()
