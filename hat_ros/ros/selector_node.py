"""Stage 3 as a node: candidates and motion in, ``/hat/selection`` out, at every frame."""

from __future__ import annotations

import sys
from typing import Any

from hat_ros.core.selector import SelectorStage
from hat_ros.io import messages, topics
from hat_ros.ros import process
from hat_ros.ros.stage_node import StageNode


class SelectorNode(StageNode):
    """Decodes which candidate is the anchor."""

    NAME = "selector"
    JOINED = (topics.HYPOTHESES_SCORED, topics.SLAM_STATE)
    NEEDS_TARGET = False

    def configure(self) -> None:
        """Build the stage and its endpoints."""
        super().configure()
        self._selection = self.output(topics.SELECTION, "fusion")
        self._anchor = self.output(topics.ANCHOR)

    def create_stage(self) -> SelectorStage:
        """The stage object."""
        return SelectorStage(self.settings.config.selector)

    def step(self, stamp_ns: int, frame_id: str, admitted: messages.Admitted, items: dict[str, Any]) -> None:
        """Selection of one frame."""
        candidates = messages.candidates_from(items[topics.HYPOTHESES_SCORED])
        selection = self.stage.update(candidates, messages.motion_from(items[topics.SLAM_STATE]))
        self._selection.publish(self.wire.selection(stamp_ns, frame_id, selection))
        if selection.selected >= 0:
            row = selection.candidates.pose_rows[selection.selected]
            self._anchor.publish(self.wire.pose(stamp_ns, frame_id, row))


def main() -> int:
    """Console script."""
    return process.main([SelectorNode])


if __name__ == "__main__":
    sys.exit(main())
