"""Stage 4 as a node: motion and selection in, ``/hat/status`` and the target's pose out."""

from __future__ import annotations

import sys

from hat_ros.ros import process
from hat_ros.ros.fusion_session import FusionSession
from hat_ros.ros.node import HatNode


class FusionNode(HatNode[FusionSession]):
    """The node of Stage 4."""

    NAME = "fusion"

    def open_session(self) -> FusionSession:
        """Build the stage and its endpoints."""
        return FusionSession(self)


def main() -> int:
    """Console script."""
    return process.main([FusionNode])


if __name__ == "__main__":
    sys.exit(main())
