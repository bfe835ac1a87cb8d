"""A small recording with masks and ground truth, for the tests of bags."""

from __future__ import annotations

import numpy as np

from hat_ros.geometry import lie
from hat_ros.io.bag_writer import BagWriter
from hat_ros.io.messages import Wire
from hat_ros.io.rosbag import TYPESTORE
from hat_ros.types import Camera

CAMERA = Camera(np.array([[60.0, 0, 19.5], [0, 60.0, 14.5], [0, 0, 1]]), 40, 30)
N = 6
WIRE = Wire.bag(TYPESTORE)


def stamp(index):
    return 1_000_000_123 + index * 100_000_000


def image(index):
    return np.random.default_rng(index).integers(0, 256, (30, 40, 3), dtype=np.uint8)


def mask(index):
    out = np.zeros((30, 40), np.uint8)
    out[5 : 10 + index, 5:20] = 255
    return out


def pose(index):
    return lie.transform(lie.so3_exp(np.array([0.1 * index, 0.2, 0.3])), np.array([0.0, 0.1, 5.0 + index]))


def write(path, n=N, **options):
    with BagWriter(path, **options) as writer:
        for index in range(n):
            given = mask(index) if index % 2 else None
            writer.write_frame(stamp(index), image(index), CAMERA, mask=given, T_cam_target=pose(index))
    return path
