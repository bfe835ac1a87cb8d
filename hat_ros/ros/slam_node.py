"""Target-relative motion as a node: ``/hat/frame`` in, ``/hat/slam_state`` out, at every frame."""

from __future__ import annotations

import sys

from hat_ros.io import topics
from hat_ros.motion.stage import MotionStage
from hat_ros.ros import process
from hat_ros.ros.joined_frames import JoinedFrame
from hat_ros.ros.node import HatNode
from hat_ros.ros.session import Session
from hat_ros.ros.stage_node import StageSession


class SlamSession(StageSession):
    """Estimates the camera's motion around the target, up to scale."""

    def __init__(self, node: HatNode[Session]) -> None:
        self._stage = MotionStage(node.settings.config, node.settings.load_target())
        super().__init__(node, self._stage, (topics.FRAME,), uses_prior=True)
        self._wire = node.wire
        self._state = node.endpoints.output(topics.SLAM_STATE, "selector", "fusion")
        self._odometry = node.endpoints.output(topics.SLAM_ODOMETRY)

    def step(self, joined: JoinedFrame) -> None:
        """Motion state of one frame."""
        frame, detection = joined.image()
        motion = self._stage.update(frame, detection, joined.prior)
        self._state.publish(self._wire.motion(joined.stamp_ns, joined.frame_id, motion))
        if motion.valid:
            self._odometry.publish(self._wire.odometry(joined.stamp_ns, joined.frame_id, motion))


class SlamNode(HatNode[SlamSession]):
    """The node of target-relative SLAM."""

    NAME = "slam"

    def open_session(self) -> SlamSession:
        """Build the stage and its endpoints."""
        return SlamSession(self)


def main() -> int:
    """Console script."""
    return process.main([SlamNode])


if __name__ == "__main__":
    sys.exit(main())
