"""CameraInfo messages and what a lens does to a picture, computed here from the models' definitions."""

from __future__ import annotations

import cv2
import numpy as np

from hat_ros.io.messages import Wire
from hat_ros.io.rosbag import TYPESTORE
from hat_ros.types import Camera

WIRE = Wire.bag(TYPESTORE)
K = np.array([[300.0, 0, 161.5], [0, 310.0, 118.5], [0, 0, 1]])
P = np.array([[280.0, 0, 158.0], [0, 282.0, 121.0], [0, 0, 1]])
SIZE = (320, 240)
# Name -> coefficients as camera_info has them; strong enough to move the corners by 10 to 40 px.
LENSES = {
    "plumb_bob": (-0.28, 0.09, 0.0005, -0.0003, -0.01),
    "rational_polynomial": (0.9, 0.1, 0.0004, -0.0002, 0.01, 1.1, 0.3, 0.02),
    "equidistant": (-0.02, 0.01, -0.004, 0.001),
    "fisheye": (0.05, -0.01, 0.0, 0.0),
}


def info(k=K, d=(0.0,) * 5, p=None, model="plumb_bob", size=SIZE, **changes):
    """A CameraInfo; without ``p`` that of K."""
    message = WIRE.camera_info(1, "cam", Camera(K, *size))
    message.k, message.d, message.distortion_model = np.ravel(k).astype(float), np.array(d, float), model
    message.p = np.column_stack([k if p is None else p, np.zeros(3)]).ravel().astype(float)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def distorted_points(x, y, model, d):
    """Where a lens puts points of the plane at depth one."""
    r2 = x * x + y * y
    if model in ("equidistant", "fisheye"):
        r = np.maximum(np.sqrt(r2), 1e-12)
        angle = np.arctan(r)
        powers = angle * (1 + d[0] * angle**2 + d[1] * angle**4 + d[2] * angle**6 + d[3] * angle**8)
        return x * powers / r, y * powers / r
    k1, k2, p1, p2, k3, k4, k5, k6 = (*d, *(0.0,) * (8 - len(d)))
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def through_lens(picture, matrix, model, d, k=K):
    """The raw image (camera matrix ``k``, a lens) of what a pinhole camera of ``matrix`` saw.

    Each raw pixel is traced back to its ray by fixed-point iteration of the definition.
    """
    height, width = picture.shape[:2]
    v, u = np.mgrid[:height, :width].astype(float)
    target_x, target_y = (u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1]
    x, y = target_x.copy(), target_y.copy()
    for _ in range(200):
        found_x, found_y = distorted_points(x, y, model, d)
        x, y = x + 0.7 * (target_x - found_x), y + 0.7 * (target_y - found_y)
    map_x, map_y = matrix[0, 0] * x + matrix[0, 2], matrix[1, 1] * y + matrix[1, 2]
    return cv2.remap(picture, map_x.astype(np.float32), map_y.astype(np.float32), cv2.INTER_LINEAR)


def smooth_picture(size=SIZE):
    """A picture that linear interpolation does not blur."""
    v, u = np.mgrid[: size[1], : size[0]].astype(float)
    waves = [np.sin(u / 23 + 1) * np.cos(v / 31), np.cos(u / 37) * np.sin(v / 19), np.sin((u + v) / 29)]
    return np.rint(127 + 110 * np.stack(waves, axis=-1)).astype(np.uint8)
