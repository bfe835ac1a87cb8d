"""Stage 1 as a node, and the only entrance of the graph: admits frames by credit, numbers them, adds the mask."""

from __future__ import annotations

import sys
import time
from functools import partial
from typing import Any

from rclpy.duration import Duration
from std_srvs.srv import Trigger

from hat_ros.core.sync import Admission
from hat_ros.errors import FrameError, StageTimeoutError
from hat_ros.io import messages, topics
from hat_ros.ros import base, process, qos
from hat_ros.ros.entrance import Entrance
from hat_ros.ros.stage_node import ExtraDelay, StepTimer
from hat_ros.segmentation.stage import SegmentationStage
from hat_ros.tracking.prior import PriorBuffer
from hat_ros.types import Frame

_STAGES = {"hypotheses", "slam", "selector", "fusion"}


class SegmentationNode(base.HatNode):
    """Admits a frame while it has a credit (W in replay, 1 live) and the whole graph is matched."""

    NAME = "segmentation"
    admission: Admission | None = None

    def configure(self) -> None:
        """Build the stage and its endpoints."""
        config, live = self.settings.config, self.settings.live
        annotated = config.segmentation.backend == "annotated"
        self.stage = SegmentationStage(config, self.settings.load_target())
        self.priors = PriorBuffer(config.prior)
        self.entrance = Entrance(live, annotated)
        self.admission = Admission(1 if live else config.graph.credits_replay)
        self.epoch = 0
        self._camera_sent = self._is_open = self._is_warm = False
        self._ready_nodes: set[str] = set()
        self._entered_s: dict[int, float] = {}
        self._delay = ExtraDelay(self.NAME, config.graph.debug_stage_delay_ms)
        self._step_timer = StepTimer()
        for topic in (topics.IMAGE, topics.IMAGE_COMPRESSED):
            self.input(topic, partial(self._on_image, topic), required=False, with_info=True)
        self.input(topics.CAMERA_INFO, self._on_camera_info, required=False)
        if annotated:
            self.input(topics.DETECTION_MASK, self._on_mask, profile=qos.IN_REPLAY, required=not live)
        self.input(topics.STATUS, self._on_status)
        self.input(topics.READY, self._on_ready, profile=qos.LATCH_READER, required=False)
        readers = ("fusion",) if config.refinement.enabled else ()
        self._camera_info = self.output(topics.HAT_CAMERA_INFO, "hypotheses", "slam", *readers)
        self._admission = self.output(topics.ADMISSION, *sorted(_STAGES))
        self._frame = self.output(topics.FRAME, "hypotheses", "slam", *readers)
        self._service = self.create_service(Trigger, topics.RESET, self._on_reset)
        self._timer = self.create_timer(0.1, partial(self.guarded, self._check_time), clock=base.STEADY)

    def cleanup(self) -> None:
        """Drop the stage, the service and the timer."""
        self.destroy_service(self._service)
        self.destroy_timer(self._timer)
        self.admission = None
        del self.stage

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics."""
        if self.admission is None:
            return {}
        admitted, flight = self.admission.seq + 1, len(self.admission.in_flight)
        counts = {"admitted": admitted, "dropped": self.entrance.dropped_total, "in_flight": flight}
        return counts | self._step_timer.values()

    def _on_image(self, topic: str, message: Any, info: dict[str, Any]) -> None:
        self.entrance.add_image(topic, message, info["publication_sequence_number"])
        self._pump()

    def _on_mask(self, message: Any) -> None:
        self.entrance.add_mask(message)
        self._pump()

    def _on_camera_info(self, message: Any) -> None:
        if self.entrance.set_camera(messages.camera_from(message)):
            self._camera_sent = False
            self._new_epoch()
        self._pump()

    def _on_status(self, message: Any) -> None:
        estimate = messages.status_from(message).estimate
        self.priors.push(estimate)
        if self.admission.answered(estimate.stamp_ns):
            del self._entered_s[estimate.stamp_ns]
            self._is_warm = True
            self.report(base.OK, "running")
        self._pump()

    def _on_ready(self, message: Any) -> None:
        self._ready_nodes.add(message.frame_id)
        self._pump()

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._new_epoch()
        response.success, response.message = True, f"epoch {self.epoch} begins with the next frame"
        return response

    def _pump(self) -> None:
        if not self._is_open:
            self._is_open = self._ready_nodes >= _STAGES and not self.unmatched()
        while self._is_open and self.admission.has_credit:
            try:
                found = self.entrance.next_frame(self.admission)
            except FrameError as error:
                self.report(base.WARN, str(error))
                continue
            if found is None:
                return
            self._admit(*found)

    def _admit(self, frame: Frame, frame_id: str) -> None:
        stamp_ns = frame.stamp_ns
        if not self._camera_sent:
            self._camera_sent = True
            self._camera_info.publish(self.wire.camera_info(stamp_ns, frame_id, frame.camera))
            self._camera_info.wait_for_all_acked(Duration(seconds=5))  # it must be there before its first image
        seq = self.admission.admit(stamp_ns)
        self._entered_s[stamp_ns] = time.monotonic()
        admitted = messages.Admitted(seq, self.entrance.dropped_total, self.epoch)
        self._admission.publish(self.wire.admission(stamp_ns, frame_id, admitted))
        self._delay.wait()
        with self._step_timer.frame():
            detection = self.stage.update(frame, self.priors.before(stamp_ns))
            self._frame.publish(self.wire.frame(stamp_ns, frame_id, frame.rgb, detection))

    def _check_time(self) -> None:
        """A stage that does not answer: a replay ends, a live graph goes on in a new epoch."""
        oldest = next(iter(self._entered_s), None)
        limit_s, option = base.answer_limit(self.settings.config.graph, first=not self._is_warm)
        if oldest is not None and time.monotonic() - self._entered_s[oldest] > limit_s:
            self.admission.give_up()
            self._entered_s.clear()
            self._new_epoch()
            self._is_open = False
            late = f"no status for frame {oldest} within {limit_s:g} s (raise {option} if it is only slow)"
            self.fail(StageTimeoutError(f"{late}: {base.HANGS}"))
        elif self._is_open and len(self.entrance) and self.entrance.camera is None:
            self.report(base.WARN, f"images arrive, but no calibration on {topics.CAMERA_INFO}")
        self._pump()

    def _new_epoch(self) -> None:
        self.epoch += 1
        self.stage.reset()
        self.priors.reset()


def main() -> int:
    """Console script."""
    return process.main([SegmentationNode])


if __name__ == "__main__":
    sys.exit(main())
