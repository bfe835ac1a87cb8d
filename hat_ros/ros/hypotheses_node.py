"""Stage 2 as a node: ``/hat/frame`` in, ``/hat/hypotheses_scored`` out, at every frame; rows only at keyframes."""

from __future__ import annotations

import sys
from typing import Any

from hat_ros.hypotheses.stage import HypothesisStage
from hat_ros.io import messages, topics
from hat_ros.ros import process
from hat_ros.ros.stage_node import StageNode


class HypothesesNode(StageNode):
    """Generates pose candidates at keyframes."""

    NAME = "hypotheses"
    JOINED = (topics.FRAME,)
    USES_PRIOR = True

    def configure(self) -> None:
        """Build the stage and its endpoints."""
        super().configure()
        self._scored = self.output(topics.HYPOTHESES_SCORED, "selector")
        self._shown = self.output(topics.HYPOTHESES)

    def create_stage(self) -> HypothesisStage:
        """The stage object."""
        return HypothesisStage(self.settings.config, self.target)

    def step(self, stamp_ns: int, frame_id: str, admitted: messages.Admitted, items: dict[str, Any]) -> None:
        """Candidates of one frame."""
        frame, detection = self.frame_of(stamp_ns, items[topics.FRAME])
        candidates = self.stage.update(frame, detection, self.prior_of(stamp_ns))
        self._scored.publish(self.wire.candidates(stamp_ns, frame_id, candidates))
        if len(candidates):
            self._shown.publish(self.wire.pose_array(stamp_ns, frame_id, candidates.pose_rows))


def main() -> int:
    """Console script."""
    return process.main([HypothesesNode])


if __name__ == "__main__":
    sys.exit(main())
