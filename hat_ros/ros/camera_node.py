"""A camera for the test bench: plays a bag as a live camera would, at any rate, with any QoS, and with its faults.

It does not wait for the graph and subscribes to nothing: what the graph cannot keep up with is the graph's loss.
``hat bench --live`` and the scenarios of the tests use it; by hand it stands for a camera that is not there::

    ros2 run hat_ros camera_node --ros-args -p bag:=bags/demo -p rate_hz:=30.0
"""

from __future__ import annotations

import sys
from typing import ClassVar

from hat_ros.ros import process
from hat_ros.ros.camera_session import CameraSession
from hat_ros.ros.node import HatNode


class CameraNode(HatNode[CameraSession]):
    """The camera of the test bench."""

    NAME = "camera"
    GOES_ON_LIVE = False
    EXTRA_PARAMETERS: ClassVar = {
        "bag": ("", "bag to play; forth and back, so that the target never jumps"),
        "rate_hz": (30.0, "images per second, whatever the recording's rate was"),
        "transport": ("recorded", "recorded: as in the bag; raw: decoded, rgb8"),
        "reliability": ("reliable", "reliable or best_effort"),
        "depth": (5, "depth of the publishers' queues"),
        "jitter_ms": (0.0, "an image is sent up to so much after its exposure"),
        "drop_share": (0.0, "share of the images that are lost on the way, 0 to 1"),
        "clock_steps": ("", "AT:BY[,AT:BY...], seconds after the first image: its clock is moved, for example 4:-60"),
        "seed": (0, "of jitter and drops"),
        "max_frames": (0, "only the first frames of the bag, 0 = all"),
        "n_sent": (0, "stop after so many images, 0 = never"),
    }

    def open_session(self) -> CameraSession:
        """Read the bag and create the endpoints."""
        return CameraSession(self)


def main() -> int:
    """Console script."""
    return process.main([CameraNode])


if __name__ == "__main__":
    sys.exit(main())
