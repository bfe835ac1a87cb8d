"""Plays a bag into the graph: nothing before every node is ready, nothing faster than the statuses come back."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from functools import partial
from typing import Any, ClassVar

import numpy as np
from rclpy.duration import Duration

from hat_ros.errors import ConfigError, StageTimeoutError
from hat_ros.io import messages, topics
from hat_ros.io.bag_reader import BagReader, Packet
from hat_ros.ros import base, process, qos

_STAGES = ["segmentation", "hypotheses", "slam", "selector", "fusion"]
_INPUT_DEPTH = 16


class PlayerNode(base.HatNode):
    """The source of a replay. It sees images, calibration and masks of the bag, never the truth.

    Attributes:
        published: frames sent so far.
        n_status: statuses received.
        last_status: the newest of them.
        sent_s: stamp -> monotonic time at which the frame was sent.
        said: node -> text of its last diagnostics.
        latency_s: from sending a frame to its status, in order of the statuses.
    """

    NAME = "player"
    GOES_ON_LIVE = False
    published = n_status = dropped = 0
    EXTRA_PARAMETERS: ClassVar = {
        "bag": ("", "bag to play"),
        "image_topic": ("", "topic of the images in the bag, empty = find it"),
        "camera_info_topic": ("", "topic of the calibration in the bag, empty = find it"),
        "rate": (1.0, "live only: speed relative to the recording"),
        "first_frame": (0, "frames skipped at the beginning"),
        "max_frames": (0, "at most this many frames, 0 = all"),
        "wait_for": (_STAGES, "nodes that must be ready before the first frame"),
    }

    def configure(self) -> None:
        """Open the bag and create the endpoints."""
        settings, extra = self.settings, self.settings.extra
        if not extra["bag"]:
            raise ConfigError("parameter 'bag' is empty: give the bag to play, -p bag:=FOLDER")
        self.bag = BagReader(
            extra["bag"],
            image_topic=extra["image_topic"] or None,
            camera_info_topic=extra["camera_info_topic"] or None,
        )
        self._packets = self._chosen()
        self._next: Packet | None = next(self._packets, None)
        self.total = max(0, len(self.bag) - extra["first_frame"])
        self.total = min(self.total, extra["max_frames"] or self.total)
        self.published = self.n_status = self.dropped = 0
        self.last_status: messages.Status | None = None
        self.sent_s: dict[int, float] = {}
        self.latency_s: list[float] = []
        self.said: dict[str, str] = {}
        self._is_open = False
        self.progress_s = time.monotonic()
        self._start: tuple[int, float] | None = None
        self._ready_nodes: set[str] = set()
        self._window = min(settings.config.graph.credits_replay + 2, _INPUT_DEPTH)
        image_topic = topics.IMAGE_COMPRESSED if self.bag.compressed else topics.IMAGE
        self._image = self.output(image_topic, "segmentation")
        self._camera_info = self.output(topics.CAMERA_INFO, "segmentation")
        annotated = settings.config.segmentation.backend == "annotated"
        self._mask = self.output(topics.DETECTION_MASK, "segmentation") if annotated else None
        self._end = self.output(topics.END_OF_STREAM)
        self.input(topics.STATUS, self._on_status)
        self.input(topics.READY, self._on_ready, profile=qos.LATCH_READER, required=False)
        self.input(topics.DIAGNOSTICS, self._on_diagnostics, required=False)
        period_s = 0.002 if settings.live else 0.05  # a replay is driven by its statuses
        self._timer = self.create_timer(period_s, partial(self.guarded, self._feed), clock=base.STEADY)

    def cleanup(self) -> None:
        """Stop playing."""
        self.destroy_timer(self._timer)
        self._packets.close()

    def _chosen(self) -> Iterator[Packet]:
        first, most = self.settings.extra["first_frame"], self.settings.extra["max_frames"]
        for index, packet in enumerate(self.bag.packets()):
            if index >= first and (not most or index < first + most):
                yield packet

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics."""
        return {"published": self.published, "answered": self.n_status}

    @property
    def outstanding(self) -> int:
        """Frames sent of which nothing has been heard yet, neither a status nor a drop."""
        return self.published - self.n_status - self.dropped

    def _on_ready(self, message: Any) -> None:
        self._ready_nodes.add(message.frame_id)

    def _on_status(self, message: Any) -> None:
        status = messages.status_from(message)
        now = time.monotonic()
        sent = self.sent_s.get(status.estimate.stamp_ns)
        if sent is not None:
            self.latency_s.append(now - sent)
        self.n_status += 1
        self.last_status, self.progress_s = status, now
        self.dropped = max(self.dropped, status.dropped_total)
        self._feed()

    def _on_diagnostics(self, message: Any) -> None:
        """Frames rejected after the last status are known from here alone; and why a node is not ready."""
        for status in message.status:
            name = status.name.removeprefix("hat: ")
            if not self._is_open and self.said.get(name) != status.message:
                self.progress_s = time.monotonic()  # whoever says something new is at work
            self.said[name] = status.message
            if status.name == "hat: segmentation":
                counts = {item.key: item.value for item in status.values}
                self.dropped = max(self.dropped, int(counts.get("dropped", 0)))

    def _feed(self) -> None:
        if not self._is_open:
            self._is_open = self._ready_nodes >= set(self.settings.extra["wait_for"]) and not self.unmatched()
            if not self._is_open:
                absent = [name for name in self.settings.extra["wait_for"] if name not in self._ready_nodes]
                why = "; ".join(f"{name}: {self.said.get(name, 'silent')}" for name in absent) or self.unmatched()
                limit_s = self.settings.config.graph.startup_timeout_s
                self._check_time(limit_s, f"the graph was not ready ({why})", "graph.startup_timeout_s")
                return
        while self._next is not None and self._may_send(self._next):
            self._send(self._next)
            self._next = next(self._packets, None)
        if self._is_done():
            self._finish()
        elif self.outstanding > 0 and not (self.settings.live and self.n_status):
            limit_s, option = base.answer_limit(self.settings.config.graph, first=not self.n_status)
            self._check_time(limit_s, f"frame {self.published - self.outstanding} was not answered", option)

    def _is_done(self) -> bool:
        """Everything sent was answered or dropped; live, where a hanging stage costs frames, the last one was."""
        if self._next is not None or self.finished:
            return False
        if self.outstanding <= 0 or not self.settings.live:
            return self.outstanding <= 0
        last_ns = max(self.sent_s)
        if self.last_status is not None and self.last_status.estimate.stamp_ns == last_ns:
            return True
        quiet_s = time.monotonic() - max(self.progress_s, self.sent_s[last_ns])
        return quiet_s > self.settings.config.graph.stage_timeout_s

    def _may_send(self, packet: Packet) -> bool:
        if not self.settings.live:
            return self.outstanding < self._window
        if self._start is None:  # real time begins when the first frame, which warms everything up, has been answered
            if self.published and self.outstanding:
                return False
            if self.published:
                self._start = (packet.stamp_ns, time.monotonic())
            return True
        since, began = self._start
        return 1e-9 * (packet.stamp_ns - since) <= (time.monotonic() - began) * self.settings.extra["rate"]

    def _send(self, packet: Packet) -> None:
        if self.published == 0:
            camera_info = self.wire.camera_info(packet.stamp_ns, self.bag.frame_id, self.bag.camera)
            self._camera_info.publish(camera_info)
        if self._mask is not None:
            empty = np.zeros((0, 0), dtype=np.uint8)
            message = packet.mask or self.wire.image(packet.stamp_ns, self.bag.frame_id, "mono8", empty)
            self._mask.publish(message)
        if self.outstanding == 0:
            self.progress_s = time.monotonic()
        self.sent_s[packet.stamp_ns] = time.monotonic()
        self._image.publish(packet.image)
        self.published += 1

    def _finish(self) -> None:
        stamp_ns = max(self.sent_s, default=0)
        self._end.publish(self.wire.header(stamp_ns, self.bag.frame_id))
        self._end.wait_for_all_acked(Duration(seconds=5))
        self.finished = True

    def _check_time(self, limit_s: float, what: str, option: str) -> None:
        if time.monotonic() - self.progress_s > limit_s:
            raise StageTimeoutError(f"{what} within {limit_s:g} s (raise {option} if it is only slow)")


def main() -> int:
    """Console script."""
    return process.main([PlayerNode])


if __name__ == "__main__":
    sys.exit(main())
