"""Stage 1 as a node, and the only entrance of the graph: admits frames by credit, numbers them, adds the mask."""

from __future__ import annotations

import sys
import time
from collections import deque
from functools import partial
from typing import Any

from std_srvs.srv import Trigger

from hat_ros.core.prior import PriorBuffer
from hat_ros.core.sync import Admission
from hat_ros.errors import FrameError, StageTimeoutError
from hat_ros.nodes import base, qos, topics, wire
from hat_ros.nodes.images import decode_image, decode_mask
from hat_ros.nodes.stage_node import ExtraDelay
from hat_ros.segmentation.stage import SegmentationStage
from hat_ros.types import Camera, Frame

_STAGES = {"hypotheses", "slam", "selector", "fusion"}
_MASKS_KEPT = 64


class SegmentationNode(base.HatNode):
    """Admits a frame while it has a credit (W in replay, 1 live) and the whole graph is matched."""

    NAME = "segmentation"
    admission: Admission | None = None

    def configure(self) -> None:
        """Build the stage and its endpoints."""
        config, live = self.settings.config, self.settings.live
        self.stage = SegmentationStage(config, self.settings.load_target())
        self.priors = PriorBuffer(config.prior)
        self.admission = Admission(1 if live else config.graph.credits_replay)
        self.dropped_total = self.epoch = 0
        self._camera: Camera | None = None
        self._camera_is_new = self._is_open = self._warm = False
        self._ready_nodes: set[str] = set()
        self._queue: deque[tuple[int, Any]] = deque()
        self._masks: dict[int, Any] | None = {} if config.segmentation.backend == "annotated" else None
        self._entered_s: dict[int, float] = {}
        self._last_number: dict[str, int] = {}
        self._delay = ExtraDelay(self.NAME, config.graph.debug_stage_delay_ms)
        for topic in (topics.IMAGE, topics.IMAGE_COMPRESSED):
            self.input(topic, partial(self._on_image, topic), required=False, with_info=True)
        self.input(topics.CAMERA_INFO, self._on_camera_info, required=False)
        if self._masks is not None:
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
        flight = len(self.admission.in_flight)
        return {"admitted": self.admission.seq + 1, "dropped": self.dropped_total, "in_flight": flight}

    # ------------------------------------------------------------ inputs

    def _on_image(self, topic: str, message: Any, info: dict[str, Any]) -> None:
        number = info["publication_sequence_number"]
        if number is not None:  # DDS overwrites the newest frame unseen while the stage works: the gap is a drop
            self.dropped_total += max(0, number - self._last_number.get(topic, number - 1) - 1)
            self._last_number[topic] = number
        if self.settings.live and self._queue:
            self._queue.clear()
            self.dropped_total += 1
        self._queue.append((wire.stamp_of(message), message))
        self._pump()

    def _on_mask(self, message: Any) -> None:
        self._masks[wire.stamp_of(message)] = message
        while len(self._masks) > _MASKS_KEPT:
            del self._masks[min(self._masks)]
        self._pump()

    def _on_camera_info(self, message: Any) -> None:
        camera = wire.camera_from(message)
        if not wire.same_camera(camera, self._camera):
            if self._camera is not None:
                if not self.settings.live:
                    raise FrameError(f"camera_info changes at {wire.stamp_of(message)} ns: a run has one calibration")
                self._new_epoch()
            self._camera, self._camera_is_new = camera, True
        self._pump()

    def _on_status(self, message: Any) -> None:
        estimate = wire.status_from(message).estimate
        self.priors.push(estimate)
        if self.admission.answered(estimate.stamp_ns):
            del self._entered_s[estimate.stamp_ns]
            self._warm = True
            self.report(base.OK, "running")
        self._pump()

    def _on_ready(self, message: Any) -> None:
        self._ready_nodes.add(message.frame_id)
        self._pump()

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._new_epoch()
        response.success, response.message = True, f"epoch {self.epoch} begins with the next frame"
        return response

    # ------------------------------------------------------------ admission

    def _pump(self) -> None:
        if not self._is_open:
            self._is_open = self._ready_nodes >= _STAGES and not self.unmatched()
        while self._is_open and self._queue and self._camera is not None and self.admission.has_credit:
            stamp_ns, message = self._queue[0]
            if self._masks is not None and stamp_ns not in self._masks:
                return  # a detector answers every image, if with an empty mask
            self._queue.popleft()
            try:
                self.admission.check(stamp_ns)
                frame = self._decode(stamp_ns, message)
            except FrameError as error:
                self.dropped_total += 1
                self.report(base.WARN, f"frame {stamp_ns} rejected: {error}")
                continue
            self._admit(frame, message.header.frame_id)

    def _decode(self, stamp_ns: int, message: Any) -> Frame:
        mask = None if self._masks is None else decode_mask(self._masks.pop(stamp_ns))
        return Frame(stamp_ns, decode_image(message), self._camera, mask)

    def _admit(self, frame: Frame, frame_id: str) -> None:
        stamp_ns = frame.stamp_ns
        if self._camera_is_new:
            self._camera_is_new = False
            self._camera_info.publish(self.wire.camera_info(stamp_ns, frame_id, frame.camera))
        seq = self.admission.admit(stamp_ns)
        self._entered_s[stamp_ns] = time.monotonic()
        admitted = wire.Admitted(seq, self.dropped_total, self.epoch)
        self._admission.publish(self.wire.admission(stamp_ns, frame_id, admitted))
        self._delay.wait()
        detection = self.stage.update(frame, self.priors.before(stamp_ns))
        self._frame.publish(self.wire.frame(stamp_ns, frame_id, frame.rgb, detection))

    def _check_time(self) -> None:
        """A stage that does not answer: a replay ends, a live graph goes on in a new epoch."""
        oldest = min(self._entered_s, key=self._entered_s.get, default=None)
        graph = self.settings.config.graph
        limit_s = graph.stage_timeout_s if self._warm else graph.startup_timeout_s  # the first frame compiles code
        if oldest is not None and time.monotonic() - self._entered_s[oldest] > limit_s:
            self.admission.give_up()
            self._entered_s.clear()
            self._new_epoch()
            self._is_open = False
            self.fail(StageTimeoutError(f"no status for frame {oldest} within {limit_s:g} s: {base.HANGS}"))
        self._pump()

    def _new_epoch(self) -> None:
        self.epoch += 1
        self.stage.reset()
        self.priors.reset()


def main() -> int:
    """Console script."""
    return base.main([SegmentationNode])


if __name__ == "__main__":
    sys.exit(main())
