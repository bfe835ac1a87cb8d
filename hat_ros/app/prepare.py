"""What a first start builds, built ahead: view banks in the cache folder, and compiled code."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from hat_ros.config import HatConfig
from hat_ros.geometry import lie
from hat_ros.io.compressed import decode_compressed
from hat_ros.io.images import NOTHING_KNOWN, encode_image
from hat_ros.target.model import Target
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.tracker import HatTracker, Stage
from hat_ros.types import Camera, Frame

# A made-up camera, and the share of its height that the target spans.
_WIDTH, _HEIGHT, _FOCAL_PX, _SPAN = 640, 480, 800.0, 0.6
_FRAMES = 3
_TURN_RAD = np.radians(2.0)


@dataclass(frozen=True)
class Part:
    """One part of a start, and how long it took."""

    name: str
    seconds: float


def prepare(config: HatConfig, target: Target) -> list[Part]:
    """Start a tracker and run it over a few rendered frames; what it builds is kept for later starts.

    Args:
        config: of all stages.
        target: the CAD model.

    Returns:
        The stages in the order in which they are built, then the frames.
    """
    parts = []
    last = time.perf_counter()

    def lap(name: str) -> None:
        nonlocal last
        now = time.perf_counter()
        parts.append(Part(name, now - last))
        last = now

    def timed(name: str, stage: Stage) -> Stage:
        lap(name)
        return stage

    tracker = HatTracker(config, target, timed)
    for frame in _frames(target):
        tracker.step(frame)
    lap(f"{_FRAMES} frames")
    return parts


def _frames(target: Target) -> list[Frame]:
    """The target before black, turning a little; images as a camera sends them, whose decoding is compiled, too."""
    K = np.array([[_FOCAL_PX, 0, _WIDTH / 2], [0, _FOCAL_PX, _HEIGHT / 2], [0, 0, 1]])
    camera = Camera(K, _WIDTH, _HEIGHT)
    renderer = RayRenderer(target)
    distance = _FOCAL_PX * target.diameter_m / (_SPAN * _HEIGHT)
    frames = []
    for index in range(_FRAMES):
        R = lie.so3_exp(np.array([0.6, 0.4 + index * _TURN_RAD, 0.2]))
        T = lie.transform(R, np.array([0, 0, distance]) - R @ target.center_m)
        image = encode_image(renderer.render(T, camera).rgb, "jpeg")
        frames.append(Frame((index + 1) * 100_000_000, decode_compressed(image, NOTHING_KNOWN)[0], camera))
    return frames
