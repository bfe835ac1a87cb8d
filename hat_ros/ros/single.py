"""All five stage nodes in one process and one executor: ``python -m hat_ros.ros.single``."""

from __future__ import annotations

import sys

from hat_ros.ros import process
from hat_ros.ros.fusion_node import FusionNode
from hat_ros.ros.hypotheses_node import HypothesesNode
from hat_ros.ros.segmentation_node import SegmentationNode
from hat_ros.ros.selector_node import SelectorNode
from hat_ros.ros.slam_node import SlamNode


def main() -> int:
    """Run the graph; ends like a single node does."""
    return process.main([SegmentationNode, HypothesesNode, SlamNode, SelectorNode, FusionNode])


if __name__ == "__main__":
    sys.exit(main())
