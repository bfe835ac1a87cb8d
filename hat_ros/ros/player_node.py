"""Plays a bag into the graph: nothing before every node is ready, nothing faster than the statuses come back."""

from __future__ import annotations

import sys
from typing import ClassVar

from hat_ros.ros import process
from hat_ros.ros.node import HatNode
from hat_ros.ros.player_session import PlayerSession

STAGES = ["segmentation", "hypotheses", "slam", "selector", "fusion"]


class PlayerNode(HatNode[PlayerSession]):
    """The source of a replay. It sees images, calibration and masks of the bag, never the ground truth."""

    NAME = "player"
    GOES_ON_LIVE = False
    EXTRA_PARAMETERS: ClassVar = {
        "bag": ("", "bag to play"),
        "image_topic": ("", "topic of the images in the bag, empty = find it"),
        "camera_info_topic": ("", "topic of the calibration in the bag, empty = find it"),
        "rate": (1.0, "live only: speed relative to the recording"),
        "first_frame": (0, "frames skipped at the beginning"),
        "max_frames": (0, "at most this many frames, 0 = all"),
        "wait_for": (STAGES, "nodes that must be ready before the first frame"),
    }

    def open_session(self) -> PlayerSession:
        """Open the bag and create the endpoints."""
        return PlayerSession(self)


def main() -> int:
    """Console script."""
    return process.main([PlayerNode])


if __name__ == "__main__":
    sys.exit(main())
