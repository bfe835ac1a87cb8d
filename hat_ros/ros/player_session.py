"""The source of a replay: sends images when the graph is ready for them, and ends the stream."""

from __future__ import annotations

import json
import time
from functools import partial
from typing import Any

import numpy as np
from rclpy.duration import Duration

from hat_ros.core.refusals import Refusals
from hat_ros.errors import ConfigError
from hat_ros.io import messages, topics
from hat_ros.io.bag_reader import BagReader, Packet
from hat_ros.ros import qos
from hat_ros.ros.diagnostics import STEADY, prefix_of
from hat_ros.ros.node import HatNode
from hat_ros.ros.playback import Playback
from hat_ros.ros.session import Session
from hat_ros.ros.timeouts import check_progress


class PlayerSession(Session):
    """Sends what :class:`~hat_ros.ros.playback.Playback` lets pass.

    Attributes:
        playback: counts and times.
        texts: node -> text of its last diagnostics.
    """

    def __init__(self, node: HatNode[Session]) -> None:
        settings, extra = node.settings, node.settings.extra
        if not extra["bag"]:
            raise ConfigError("parameter 'bag' is empty: give the bag to play, -p bag:=FOLDER")
        self._node, self._wire, self._config = node, node.wire, settings.config.graph
        self._bag = BagReader(
            extra["bag"],
            image_topic=extra["image_topic"] or None,
            camera_info_topic=extra["camera_info_topic"] or None,
            camera_config=settings.config.camera,
        )
        self._calibration = self._bag.calibration
        choice = {name: extra[name] for name in ("rate", "first_frame", "max_frames")}
        self.playback = Playback(self._bag, self._config, live=settings.live, **choice)
        self.texts: dict[str, str] = {}
        self._prefix = prefix_of(node)
        self._is_open = False
        self._wait_for: list[str] = extra["wait_for"]
        self._ready_nodes: set[str] = set()
        output, subscribe = node.endpoints.output, node.endpoints.input
        self._image = output(topics.IMAGE_COMPRESSED if self._bag.compressed else topics.IMAGE, "segmentation")
        self._camera_info = output(topics.CAMERA_INFO, "segmentation")
        annotated = settings.config.segmentation.backend == "annotated"
        self._mask = output(topics.DETECTION_MASK, "segmentation") if annotated else None
        self._end = output(topics.END_OF_STREAM)
        subscribe(topics.STATUS, self._on_status)
        subscribe(topics.READY, self._on_ready, profile=qos.LATCH_READER, required=False)
        subscribe(topics.DIAGNOSTICS, self.on_diagnostics, required=False)
        period_s = 0.002 if settings.live else 0.05  # a replay is driven by its statuses
        self._timer = node.create_timer(period_s, partial(node.guarded, self.feed), clock=STEADY)

    def close(self) -> None:
        """Stop playing."""
        self._node.destroy_timer(self._timer)
        self.playback.close()

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics."""
        return self.playback.summary()

    def _on_ready(self, message: Any) -> None:
        if message.stamp.sec > 0:
            self._ready_nodes.add(message.frame_id)
        else:
            self._ready_nodes.discard(message.frame_id)

    def _on_status(self, message: Any) -> None:
        self.playback.note_status(messages.status_from(message))
        self.feed()

    def on_diagnostics(self, message: Any) -> None:
        """Frames refused after the last status are known from here alone; and why a node is not ready."""
        for status in message.status:
            if not status.name.startswith(self._prefix):
                continue
            name = status.name.removeprefix(self._prefix)
            if not self._is_open and self.texts.get(name) != status.message:
                self.playback.progress_s = time.monotonic()  # a node with a new text is at work
            self.texts[name] = status.message
            if name == "segmentation":
                counts = {item.key: item.value for item in status.values}
                self.playback.note_dropped(int(counts.get("dropped", 0)))
                self.playback.refusals = Refusals.from_records(json.loads(counts.get(topics.REFUSED_REASONS, "[]")))

    def feed(self) -> None:
        """Send what may be sent now; at the end, end the stream.

        Raises:
            StageTimeoutError: the graph is not ready or does not answer in time.
        """
        if not self._is_open:
            self._is_open = self._ready_nodes >= set(self._wait_for) and not self._node.endpoints.unmatched()
            if not self._is_open:
                self._check_readiness()
                return
        while (packet := self.playback.take()) is not None:
            self._send(packet)
        if self.playback.is_done() and not self._node.finished:
            self._finish()
        else:
            self.playback.check_answers()

    def _check_readiness(self) -> None:
        absent = [name for name in self._wait_for if name not in self._ready_nodes]
        found = "; ".join(f"{name}: {self.texts.get(name, 'no diagnostics yet')}" for name in absent)
        why = found or self._node.endpoints.unmatched()
        limit_s = self._config.startup_timeout_s
        check_progress(self.playback.progress_s, limit_s, f"the graph was not ready ({why})", "graph.startup_timeout_s")

    def _send(self, packet: Packet) -> None:
        if self.playback.sent == 1:
            camera_info = self._wire.camera_info(
                packet.stamp_ns, self._bag.frame_id, self._calibration.camera, self._calibration.lens
            )
            self._camera_info.publish(camera_info)
        if self._mask is not None:
            empty = np.zeros((0, 0), dtype=np.uint8)
            self._mask.publish(packet.mask or self._wire.image(packet.stamp_ns, self._bag.frame_id, "mono8", empty))
        self._image.publish(packet.image)

    def _finish(self) -> None:
        stamp_ns = max(self.playback.sent_s, default=0)
        self._end.publish(self._wire.header(stamp_ns, self._bag.frame_id))
        self._end.wait_for_all_acked(Duration(seconds=5))
        self._node.finished = True
