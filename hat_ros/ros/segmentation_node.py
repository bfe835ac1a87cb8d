"""Stage 1 as a node, and the only entrance of the graph: images in, ``/hat/admission`` and ``/hat/frame`` out."""

from __future__ import annotations

import sys

from hat_ros.ros import process
from hat_ros.ros.node import HatNode
from hat_ros.ros.segmentation_session import SegmentationSession


class SegmentationNode(HatNode[SegmentationSession]):
    """The node of Stage 1."""

    NAME = "segmentation"

    def open_session(self) -> SegmentationSession:
        """Build the stage and its endpoints."""
        return SegmentationSession(self)


def main() -> int:
    """Console script."""
    return process.main([SegmentationNode])


if __name__ == "__main__":
    sys.exit(main())
