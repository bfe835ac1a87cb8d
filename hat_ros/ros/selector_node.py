"""Stage 3 as a node: candidates and motion in, ``/hat/selection`` out, at every frame."""

from __future__ import annotations

import sys

from hat_ros.core.selector import SelectorStage
from hat_ros.io import messages, topics
from hat_ros.ros import process
from hat_ros.ros.joined_frames import JoinedFrame
from hat_ros.ros.node import HatNode
from hat_ros.ros.session import Session
from hat_ros.ros.stage_node import StageSession


class SelectorSession(StageSession):
    """Decodes which candidate is the anchor."""

    def __init__(self, node: HatNode[Session]) -> None:
        self._stage = SelectorStage(node.settings.config.selector)
        super().__init__(node, self._stage, (topics.HYPOTHESES_SCORED, topics.SLAM_STATE))
        self._wire = node.wire
        self._selection = node.endpoints.output(topics.SELECTION, "fusion")
        self._anchor = node.endpoints.output(topics.ANCHOR)

    def step(self, joined: JoinedFrame) -> None:
        """Selection of one frame."""
        candidates = messages.candidates_from(joined.items[topics.HYPOTHESES_SCORED])
        selection = self._stage.update(candidates, messages.motion_from(joined.items[topics.SLAM_STATE]))
        self._selection.publish(self._wire.selection(joined.stamp_ns, joined.frame_id, selection))
        if selection.selected >= 0:
            row = selection.candidates.pose_rows[selection.selected]
            self._anchor.publish(self._wire.pose(joined.stamp_ns, joined.frame_id, row))


class SelectorNode(HatNode[SelectorSession]):
    """The node of Stage 3."""

    NAME = "selector"

    def open_session(self) -> SelectorSession:
        """Build the stage and its endpoints."""
        return SelectorSession(self)


def main() -> int:
    """Console script."""
    return process.main([SelectorNode])


if __name__ == "__main__":
    sys.exit(main())
