"""Stage 2 as a node: ``/hat/frame`` in, ``/hat/hypotheses_scored`` out, at every frame; rows only at keyframes."""

from __future__ import annotations

import sys

from hat_ros.hypotheses.stage import HypothesisStage
from hat_ros.io import topics
from hat_ros.ros import process
from hat_ros.ros.joined_frames import JoinedFrame
from hat_ros.ros.node import HatNode
from hat_ros.ros.session import Session
from hat_ros.ros.stage_node import StageSession


class HypothesesSession(StageSession):
    """Generates pose candidates at keyframes."""

    def __init__(self, node: HatNode[Session]) -> None:
        self._stage = HypothesisStage(node.settings.config, node.settings.load_target())
        super().__init__(node, self._stage, (topics.FRAME,), uses_prior=True, takes_given=True)
        self._wire = node.wire
        self._scored = node.endpoints.output(topics.HYPOTHESES_SCORED, "selector")
        self._shown = node.endpoints.output(topics.HYPOTHESES)

    def step(self, joined: JoinedFrame) -> None:
        """Candidates of one frame."""
        frame, detection = joined.image()
        candidates = self._stage.update(frame, detection, joined.prior, joined.given)
        self._scored.publish(self._wire.candidates(joined.stamp_ns, joined.frame_id, candidates))
        if len(candidates):
            self._shown.publish(self._wire.pose_array(joined.stamp_ns, joined.frame_id, candidates.pose_rows))


class HypothesesNode(HatNode[HypothesesSession]):
    """The node of Stage 2."""

    NAME = "hypotheses"

    def open_session(self) -> HypothesesSession:
        """Build the stage and its endpoints."""
        return HypothesesSession(self)


def main() -> int:
    """Console script."""
    return process.main([HypothesesNode])


if __name__ == "__main__":
    sys.exit(main())
