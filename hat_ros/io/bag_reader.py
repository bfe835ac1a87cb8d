"""Reads recordings: rosbag2 folders with images, calibration, perhaps masks and ground truth, and the CAD model.

Bags of any origin are read: any topic names, MCAP or sqlite3 storage, one file or many, with or without a
manifest. No ROS is needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.array_types import Float, UInt8
from hat_ros.config import CameraConfig
from hat_ros.errors import BagError, FrameError, HatError
from hat_ros.geometry import lie
from hat_ros.io import messages, topics
from hat_ros.io.bag_files import BagFiles
from hat_ros.io.calibration import Calibration, calibration_from
from hat_ros.io.frame_decoder import FrameDecoder
from hat_ros.io.manifest import TARGET_FILE, check_manifest
from hat_ros.io.rosbag import deserialize, stamp_of_cdr
from hat_ros.io.topic_choice import COMPRESSED_KIND, IMAGE_KIND, choose_camera_info, choose_image
from hat_ros.types import Camera, Frame

_POSE_TYPE = "geometry_msgs/msg/PoseStamped"


@dataclass(frozen=True)
class Packet:
    """One recorded image as it stands in the bag, for playing.

    Attributes:
        stamp_ns: stamp of the image's header.
        image: serialized message (CDR).
        compressed: it is a CompressedImage.
        mask: serialized mask message of the same stamp, None when there is none.
    """

    stamp_ns: int
    image: bytes
    compressed: bool
    mask: bytes | None


class BagReader:
    """Reads a recording.

    Args:
        path: the bag's folder, with or without ``metadata.yaml``, or a single ``.mcap`` or ``.db3`` file.
        image_topic: topic of the images; None = see :func:`~hat_ros.io.topic_choice.choose_image`.
        camera_info_topic: topic of the calibration; None = see :func:`~hat_ros.io.topic_choice.choose_camera_info`.
        mask_topic: topic of given detections (mono8: 255 silhouette, 128 box, 0 outside).
        truth_topic: topic of true poses (PoseStamped, ``T_cam_target``); only for evaluation.
        camera_config: what the messages do not say of the camera; None = find out.

    Raises:
        BagError: missing, truncated or altered bag, or a topic that is missing, ambiguous or of another type.
        FrameError: the calibration is unusable.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        image_topic: str | None = None,
        camera_info_topic: str | None = None,
        mask_topic: str = topics.DETECTION_MASK,
        truth_topic: str = topics.GROUND_TRUTH,
        camera_config: CameraConfig | None = None,
    ) -> None:
        self.path = Path(path)
        self._camera_config = camera_config or CameraConfig()
        self._has_decoder = False
        check_manifest(self.path)
        self._files = BagFiles(self.path)
        try:
            self.image_topic = choose_image(self._files.topics, image_topic, self._first_encoding)
            self.camera_info_topic = choose_camera_info(self._files.topics, camera_info_topic, self.image_topic)
        except BagError as error:
            raise BagError(f"{self.path} {error}") from None
        self.mask_topic = self._optional("mask", mask_topic, IMAGE_KIND)
        self.truth_topic = self._optional("truth", truth_topic, _POSE_TYPE)

    def _first_encoding(self, topic: str) -> str:
        return next((str(message.encoding) for message in self.messages(topic)), "")

    def _optional(self, what: str, topic: str, kind: str) -> str | None:
        found = self._files.topics.get(topic)
        if found is None:
            return None
        if found.kind != kind:
            raise BagError(f"{self.path}: {what} topic '{topic}' must be {kind}, found {found.kind}")
        return topic if found.count else None

    def messages(self, topic: str) -> Iterator[Any]:
        """All messages of a topic, deserialized, in recorded order."""
        for message in self._files.messages((topic,)):
            yield deserialize(message.data, message.kind, self.path)

    def __len__(self) -> int:
        return self._files.topics[self.image_topic].count

    @property
    def topics(self) -> dict[str, str]:
        """Topic -> message type of everything in the bag."""
        return {name: topic.kind for name, topic in self._files.topics.items()}

    @property
    def compressed(self) -> bool:
        """The images are JPEG or PNG."""
        return self._files.topics[self.image_topic].kind == COMPRESSED_KIND

    @property
    def has_masks(self) -> bool:
        """Detections come with the images."""
        return self.mask_topic is not None

    @cached_property
    def target_path(self) -> Path | None:
        """``target.yaml`` of the bag, None when it brings none."""
        path = (self.path if self.path.is_dir() else self.path.parent) / TARGET_FILE
        return path if path.is_file() else None

    @cached_property
    def calibration(self) -> Calibration:
        """The calibration; one for the whole bag. Messages that say "not calibrated" are skipped.

        Raises:
            BagError: there is none, or it changes.
            FrameError: it is unusable, or does not say which image it describes.
        """
        first: Calibration | None = None
        for message in self.messages(self.camera_info_topic):
            try:
                found = calibration_from(message, self.image_topic, self._camera_config.rectified)
            except HatError as error:
                raise FrameError(f"{self.path}, {self.camera_info_topic}: {error}") from None
            if found is None:
                continue
            first = first or found
            if not first.is_same(found):
                raise BagError(
                    f"{self.path}: the calibration changes at stamp {messages.stamp_of(message)}: split the bag"
                )
        if first is None:
            raise BagError(self._no_calibration())
        return first

    def _no_calibration(self) -> str:
        topic = f"{self.path}: topic {self.camera_info_topic}"
        if not self._files.topics[self.camera_info_topic].count:
            return f"{topic} has no message: the calibration is missing"
        return f"{topic} says that the camera is not calibrated, K has no focal length: calibrate it or give K"

    @property
    def camera(self) -> Camera:
        """The pinhole camera of all frames."""
        return self.calibration.camera

    def decoder(self) -> FrameDecoder:
        """What decodes the frames of one pass over the bag; only that of the first pass logs."""
        quiet, self._has_decoder = self._has_decoder, True
        return FrameDecoder(self.calibration, self._camera_config.image_depth, quiet)

    @cached_property
    def frame_id(self) -> str:
        """``header.frame_id`` of the images."""
        return next((message.header.frame_id for message in self.messages(self.image_topic)), "")

    def frames(self) -> Iterator[Frame]:
        """Decoded frames in recorded order, stamps as they stand (admission is the pipeline's business).

        Raises:
            BagError: the bag breaks off or cannot be deserialized.
            FrameError: an image or mask is malformed; the message names its stamp.
        """
        decoder = self.decoder()
        for packet in self.packets():
            try:
                yield self.decoded(packet, decoder)
            except FrameError as error:
                raise FrameError(f"{self.path}, frame {packet.stamp_ns}: {error}") from None

    def decoded(self, packet: Packet, decoder: FrameDecoder, masks: bool = True) -> Frame:
        """The frame of a packet, with its mask if wanted.

        Raises:
            BagError: a message cannot be deserialized.
            FrameError: an image or mask is malformed.
        """
        image = deserialize(packet.image, self._files.topics[self.image_topic].kind, self.path)
        return decoder.frame(packet.stamp_ns, image, self._mask_message(packet) if masks else None)

    def decoded_mask(self, packet: Packet, decoder: FrameDecoder) -> UInt8 | None:
        """The mask of a packet alone; errors as in :meth:`decoded`."""
        message = self._mask_message(packet)
        return None if message is None else decoder.mask(message)

    def _mask_message(self, packet: Packet) -> Any | None:
        return None if packet.mask is None else deserialize(packet.mask, IMAGE_KIND, self.path)

    def packets(self) -> Iterator[Packet]:
        """The images as recorded, each with the mask of its exact stamp."""
        masks = _ByStamp(self._stamped(self.mask_topic)) if self.mask_topic else None
        for stamp_ns, data in self._stamped(self.image_topic):
            yield Packet(stamp_ns, data, self.compressed, masks.take(stamp_ns) if masks else None)

    def _stamped(self, topic: str) -> Iterator[tuple[int, bytes]]:
        for message in self._files.messages((topic,)):
            yield stamp_of_cdr(message.data, self.path), message.data

    def truth(self) -> dict[int, Float]:
        """True ``T_cam_target`` (4, 4) by exact stamp; empty when the bag has none.

        Raises:
            BagError: a pose is not finite or its quaternion not of unit length.
        """
        return {stamp: lie.matrix_from_row(row) for stamp, row in self.truth_rows().items()}

    def truth_rows(self) -> dict[int, Float]:
        """True pose rows (7,) by exact stamp, as recorded."""
        out: dict[int, Float] = {}
        for message in self.messages(self.truth_topic) if self.truth_topic else ():
            row = messages.pose_row_from(message.pose)
            if not np.isfinite(row).all() or abs(math.hypot(*row[3:]) - 1) > 1e-3:
                raise BagError(
                    f"{self.path}: true pose at stamp {messages.stamp_of(message)} is no pose: {row.tolist()}"
                )
            out[messages.stamp_of(message)] = row
        return out


class _ByStamp:
    """Finds the message of an exact stamp in a stream that runs alongside; forgets what can no longer be asked for."""

    _BEHIND = 64

    def __init__(self, stream: Iterator[tuple[int, bytes]]) -> None:
        self._stream = stream
        self._waiting: dict[int, bytes] = {}
        self._newest = -1

    def take(self, stamp_ns: int) -> bytes | None:
        while self._newest < stamp_ns:
            read = next(self._stream, None)
            if read is None:
                break
            self._newest = max(self._newest, read[0])
            self._waiting[read[0]] = read[1]
        found = self._waiting.pop(stamp_ns, None)
        while len(self._waiting) > self._BEHIND:
            self._waiting.pop(min(self._waiting))
        return found
