"""Stage 4 in a node: motion and selection in, status and pose out."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from hat_ros.core.fusion import FusionStage
from hat_ros.geometry.symmetry import known_up_to
from hat_ros.io import messages, topics
from hat_ros.ros.diagnostics import OK
from hat_ros.ros.joined_frames import JoinedFrame
from hat_ros.ros.node import HatNode
from hat_ros.ros.pose_output import PoseOutput
from hat_ros.ros.session import Session
from hat_ros.ros.stage_node import StageSession
from hat_ros.target.exact_symmetry import symmetry_of
from hat_ros.tracker import choose_fusion
from hat_ros.types import Camera, Detection, Estimate, Frame, TrackState

# Without a refiner only the frame's stamp counts, so no image is sent here.
_NO_CAMERA = Camera(np.eye(3), 1, 1)
_NO_IMAGE = np.zeros((1, 1, 3), dtype=np.uint8)


class FusionSession(StageSession):
    """Fuses anchors and motion into one pose per frame."""

    def __init__(self, node: HatNode[Session]) -> None:
        settings, config = node.settings, node.settings.config
        target = settings.load_target()
        self._stage = FusionStage(config, choose_fusion(config, target), symmetry_of(target))
        images = (topics.FRAME,) if config.refinement.enabled else ()
        super().__init__(node, self._stage, (topics.SLAM_STATE, topics.SELECTION, *images))
        self._wire = node.wire
        self._estimate: Estimate | None = None
        self._log = node.get_logger()
        self._pose_hz, self._rated = 0.0, (time.monotonic(), 0)
        readers = ("hypotheses", "slam") if config.prior.enabled else ()
        self._status = node.endpoints.output(topics.STATUS, "segmentation", *readers)
        frame_id, graph = settings.target_frame_id or target.name, config.graph
        self._pose = PoseOutput(
            node.endpoints, node.wire, frame_id, graph.publish_initialising, publish_tf=settings.publish_tf
        )
        self._resumed_epoch = -1

    def step(self, joined: JoinedFrame) -> None:
        """Estimate of one frame; the status goes last, because it lets the next frame in."""
        admitted = joined.admitted
        if admitted.resumed and admitted.epoch != self._resumed_epoch:
            self._resumed_epoch = admitted.epoch
            self._stage.resume()
        frame, detection = _image(joined)
        motion = messages.motion_from(joined.items[topics.SLAM_STATE])
        selection = messages.selection_from(joined.items[topics.SELECTION])
        estimate = self._stage.update(frame, detection, motion, selection)
        self._pose.publish(joined.frame_id, estimate)
        self._log_change(estimate)
        self._estimate = estimate
        self._status.publish(self._wire.status(joined.frame_id, estimate, admitted))
        up_to = known_up_to(estimate.order, estimate.free_axes)
        words = f"{estimate.reason.words}; {up_to}" if up_to else estimate.reason.words
        self._diagnostics.report(OK, f"{estimate.state.name.lower()}: {words}")

    def _log_change(self, estimate: Estimate) -> None:
        before = TrackState.UNINITIALISED if self._estimate is None else self._estimate.state
        if estimate.state == before:
            return
        sentence = f"{before.name.lower()} -> {estimate.state.name.lower()}: {estimate.reason.words}"
        if estimate.state == TrackState.LOST:
            self._log.warning(sentence)
        else:
            self._log.info(sentence)

    def every_second(self) -> None:
        """Measure the rate of poses."""
        super().every_second()
        now, n_poses = time.monotonic(), self._pose.n_published
        self._pose_hz = (n_poses - self._rated[1]) / (now - self._rated[0])
        self._rated = (now, n_poses)

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics; the smaller the margin, the more ambiguous the orientation."""
        if self._estimate is None:
            return super().values()
        e = self._estimate
        own = {"state": int(e.state), "reason": int(e.reason), "margin": e.margin, "gap_frames": e.gap_frames}
        return {**super().values(), **own, "pose_hz": f"{self._pose_hz:.1f}"}


def _image(joined: JoinedFrame) -> tuple[Frame, Detection | None]:
    return joined.image() if topics.FRAME in joined.items else (Frame(joined.stamp_ns, _NO_IMAGE, _NO_CAMERA), None)
