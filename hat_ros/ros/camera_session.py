"""What the camera of the test bench does: sends the images of a bag when its script says so."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message

from hat_ros.errors import ConfigError
from hat_ros.io import topics
from hat_ros.io.bag_reader import BagReader
from hat_ros.ros.camera_script import CameraScript, ClockStep, Shot
from hat_ros.ros.diagnostics import STEADY
from hat_ros.ros.node import HatNode
from hat_ros.ros.session import Session

_RELIABILITY = {"reliable": ReliabilityPolicy.RELIABLE, "best_effort": ReliabilityPolicy.BEST_EFFORT}
_TRANSPORTS = ("recorded", "raw")
# header.stamp of a message in CDR: seconds and nanoseconds, behind the four octets of its head.
_STAMP = struct.Struct("<iI")
_STAMP_AT = 4


class CameraSession(Session):
    """Sends what the script says, when it says so."""

    def __init__(self, node: HatNode[Session]) -> None:
        extra = node.settings.extra
        self._node, self._wire = node, node.wire
        if not extra["bag"]:
            raise ConfigError("parameter 'bag' is empty: give the bag to play, -p bag:=FOLDER")
        if extra["reliability"] not in _RELIABILITY or extra["transport"] not in _TRANSPORTS:
            raise ConfigError(
                f"reliability is one of {', '.join(_RELIABILITY)} and transport one of {', '.join(_TRANSPORTS)}, "
                f"found '{extra['reliability']}' and '{extra['transport']}'"
            )
        bag = BagReader(extra["bag"], camera_config=node.settings.config.camera)
        self._compressed = bag.compressed and extra["transport"] == "recorded"
        self._images = self._serialized(bag, extra["max_frames"])
        script = CameraScript(
            n_images=len(self._images),
            rate_hz=extra["rate_hz"],
            jitter_ms=extra["jitter_ms"],
            drop_share=extra["drop_share"],
            clock_steps=[ClockStep.parse(text) for text in extra["clock_steps"].split(",") if text],
            seed=extra["seed"],
        )
        calibration = bag.calibration
        info = self._wire.camera_info(0, bag.frame_id, calibration.camera, calibration.lens)
        self._info_octets = bytearray(serialize_message(info))
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST, depth=extra["depth"], reliability=_RELIABILITY[extra["reliability"]]
        )
        output = node.endpoints.output
        self._image = output(topics.IMAGE_COMPRESSED if self._compressed else topics.IMAGE, profile=profile)
        self._camera_info = output(topics.CAMERA_INFO, profile=profile)
        self._shots: Iterator[Shot] = script.shots()
        self._next, self._left = next(self._shots), extra["n_sent"] or -1
        self._started: tuple[float, int] | None = None
        self._sent = 0
        self._timer = node.create_timer(1.0 / extra["rate_hz"], partial(node.guarded, self._send_due), clock=STEADY)

    def _serialized(self, bag: BagReader, max_frames: int) -> list[bytearray]:
        """The clip as it goes over the wire but for the stamps, so that sending costs next to nothing."""
        out: list[bytearray] = []
        decoder = bag.decoder()
        for packet in bag.packets():
            if self._compressed or not bag.compressed:
                out.append(bytearray(packet.image))
            else:
                rgb = bag.decoded(packet, decoder, masks=False).rgb
                out.append(bytearray(serialize_message(self._wire.image(0, bag.frame_id, "rgb8", rgb))))
            if len(out) == max_frames:
                break
        return out

    def close(self) -> None:
        """Stop sending."""
        self._node.destroy_timer(self._timer)

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics."""
        return {"sent": self._sent}

    def _send_due(self) -> None:
        """Send all images whose time has come, and sleep until the next one."""
        if self._started is None:
            self._started = (time.monotonic(), time.time_ns())
        start_s, start_ns = self._started
        while self._left and time.monotonic() - start_s >= self._next.due_s:
            self._send(self._next, start_ns)
            self._next = next(self._shots)
        wait_s = self._next.due_s - (time.monotonic() - start_s)
        self._timer.timer_period_ns = max(1, round(1e9 * wait_s))
        self._timer.reset()

    def _send(self, shot: Shot, start_ns: int) -> None:
        stamp = divmod(start_ns + shot.offset_ns, 1_000_000_000)
        # Every driver sends both for each image.
        for octets, publisher in ((self._info_octets, self._camera_info), (self._images[shot.index], self._image)):
            _STAMP.pack_into(octets, _STAMP_AT, *stamp)
            publisher.publish(bytes(octets))
        self._sent += 1
        self._left -= 1
        if not self._left:
            self._node.finished = self._node.settings.exit_at_end
