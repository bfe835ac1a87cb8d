"""Target-relative motion as a node: ``/hat/frame`` in, ``/hat/slam_state`` out, at every frame."""

from __future__ import annotations

import sys
from typing import Any

from hat_ros.io import messages, topics
from hat_ros.motion.stage import MotionStage
from hat_ros.ros import process
from hat_ros.ros.stage_node import StageNode


class SlamNode(StageNode):
    """Estimates the camera's motion around the target, up to scale."""

    NAME = "slam"
    JOINED = (topics.FRAME,)
    USES_PRIOR = True

    def configure(self) -> None:
        """Build the stage and its endpoints."""
        super().configure()
        self._state = self.output(topics.SLAM_STATE, "selector", "fusion")
        self._odometry = self.output(topics.SLAM_ODOMETRY)

    def create_stage(self) -> MotionStage:
        """The stage object."""
        return MotionStage(self.settings.config, self.target)

    def step(self, stamp_ns: int, frame_id: str, admitted: messages.Admitted, items: dict[str, Any]) -> None:
        """Motion state of one frame."""
        frame, detection = self.frame_of(stamp_ns, items[topics.FRAME])
        motion = self.stage.update(frame, detection, self.prior_of(stamp_ns))
        self._state.publish(self.wire.motion(stamp_ns, frame_id, motion))
        if motion.valid:
            self._odometry.publish(self.wire.odometry(stamp_ns, frame_id, motion))


def main() -> int:
    """Console script."""
    return process.main([SlamNode])


if __name__ == "__main__":
    sys.exit(main())
