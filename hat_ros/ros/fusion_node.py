"""Stage 4 as a node: motion and selection in, ``/hat/status`` and the target's pose out."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import Any

import numpy as np

from hat_ros.core.fusion import FusionStage
from hat_ros.io import messages, topics
from hat_ros.ros import base, process
from hat_ros.ros.stage_node import StageNode
from hat_ros.tracker import choose_fusion
from hat_ros.types import Camera, Detection, Estimate, Frame

# Without a refiner only the frame's stamp counts, so no image is sent here.
_NO_CAMERA = Camera(np.eye(3), 1, 1)
_NO_IMAGE = np.zeros((1, 1, 3), dtype=np.uint8)


class FusionNode(StageNode):
    """Fuses anchors and motion into one pose per frame."""

    NAME = "fusion"
    JOINED = (topics.SLAM_STATE, topics.SELECTION)

    def configure(self) -> None:
        """Build the stage and its endpoints."""
        super().configure()
        self._version = 0
        self._margin = float("nan")
        readers = ("hypotheses", "slam") if self.settings.config.prior.enabled else ()
        names = (
            topics.TARGET_POSE,
            topics.TARGET_POSE_WITH_COVARIANCE,
            topics.ALIGNMENT,
            topics.ALIGNMENT_TRANSFORM,
            *((topics.TF,) if find_spec("tf2_msgs") else ()),
        )
        self._status = self.output(topics.STATUS, "segmentation", *readers)
        self._emit = {topic: self.output(topic) for topic in names}

    def joined(self) -> tuple[str, ...]:
        """The image is needed by refinement alone."""
        return (*self.JOINED, topics.FRAME) if self.settings.config.refinement.enabled else self.JOINED

    def create_stage(self) -> FusionStage:
        """The stage object."""
        return FusionStage(self.settings.config, choose_fusion(self.settings.config, self.target))

    def step(self, stamp_ns: int, frame_id: str, admitted: messages.Admitted, items: dict[str, Any]) -> None:
        """Estimate of one frame; the status goes last, because it lets the next frame in."""
        frame, detection = self._image(stamp_ns, items)
        motion = messages.motion_from(items[topics.SLAM_STATE])
        estimate = self.stage.update(frame, detection, motion, messages.selection_from(items[topics.SELECTION]))
        self._publish_alignment(stamp_ns, estimate)
        if estimate.state.has_pose:
            self._publish_pose(frame_id, estimate)
        self._margin = estimate.margin
        self._status.publish(self.wire.status(frame_id, estimate, admitted))
        self.report(base.OK, estimate.state.name.lower())

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics; the smaller the margin, the more ambiguous the orientation."""
        return {**super().values(), "margin": self._margin}

    def _image(self, stamp_ns: int, items: dict[str, Any]) -> tuple[Frame, Detection | None]:
        if topics.FRAME in items:
            return self.frame_of(stamp_ns, items[topics.FRAME])
        return Frame(stamp_ns, _NO_IMAGE, _NO_CAMERA), None

    def _publish_pose(self, frame_id: str, estimate: Estimate) -> None:
        stamp_ns, row, make = estimate.stamp_ns, estimate.pose_row, self.wire
        self._emit[topics.TARGET_POSE].publish(make.pose(stamp_ns, frame_id, row))
        message = make.pose_with_covariance(stamp_ns, frame_id, row, estimate.covariance)
        self._emit[topics.TARGET_POSE_WITH_COVARIANCE].publish(message)
        if topics.TF in self._emit:
            transform = make.transform(stamp_ns, frame_id, self._target_frame_id, row)
            self._emit[topics.TF].publish(messages.message_class(topics.TYPES[topics.TF])(transforms=[transform]))

    def _publish_alignment(self, stamp_ns: int, estimate: Estimate) -> None:
        alignment = estimate.alignment
        version = 0 if alignment is None else alignment.version
        if alignment is not None and version != self._version:
            slam_frame_id = f"slam_{alignment.epoch}"
            row = np.concatenate([alignment.translation_m, alignment.quat_xyzw])
            message = self.wire.alignment(stamp_ns, slam_frame_id, alignment)
            self._emit[topics.ALIGNMENT].publish(message)
            transform = self.wire.transform(stamp_ns, self._target_frame_id, slam_frame_id, row)
            self._emit[topics.ALIGNMENT_TRANSFORM].publish(transform)
        self._version = version

    @property
    def _target_frame_id(self) -> str:
        return self.settings.target_frame_id or self.target.name


def main() -> int:
    """Console script."""
    return process.main([FusionNode])


if __name__ == "__main__":
    sys.exit(main())
