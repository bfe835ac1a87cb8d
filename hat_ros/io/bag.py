"""Recordings: rosbag2 folders with images, calibration, perhaps masks and truth, and the target's CAD model.

A bag of ours is a folder ``NAME/`` with ``metadata.yaml``, ``NAME.mcap``, ``target.yaml`` and the mesh that it names,
and ``manifest.json`` with the SHA-256 of each, because neither MCAP's optional checksums nor ``rosbags`` notice every
flipped bit. Bags of others (any topic names, sqlite3 storage, no manifest) are read too. No ROS is needed here.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
import yaml
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from hat_ros.array_types import Float, UInt8
from hat_ros.errors import BagError, FrameError, HatError, RunError
from hat_ros.geometry import lie
from hat_ros.io import messages, topics
from hat_ros.io.bag_files import RESERVE, ReservedFile, check_manifest, write_manifest
from hat_ros.io.images import decode_image, decode_mask
from hat_ros.io.integrity import check_mcap
from hat_ros.types import Camera, Frame

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
TARGET_FILE = "target.yaml"

_IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
_MASK_TYPE = "sensor_msgs/msg/Image"
_POSE_TYPE = "geometry_msgs/msg/PoseStamped"
_MAX_METADATA_BYTES = 16 * 2**20


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
        path: the bag's folder, or a single ``.mcap`` file.
        image_topic: topic of the images; found by itself when the bag has ``/image``, ``/image/compressed`` or only one
            image topic.
        camera_info_topic: topic of the calibration; found likewise.
        mask_topic: topic of given detections (mono8: 255 silhouette, 128 box, 0 outside).
        truth_topic: topic of true poses (PoseStamped, ``T_cam_target``); only for evaluation.

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
    ) -> None:
        self.path = Path(path)
        self._check_files()
        with self._open() as reader:
            self._types = {c.topic: c.msgtype for c in reader.connections}
            self._counts = {c.topic: c.msgcount for c in reader.connections}
        self.image_topic = self._choose("image", image_topic, _IMAGE_TYPES, topics.IMAGE, topics.IMAGE_COMPRESSED)
        self.camera_info_topic = self._choose(
            "camera_info", camera_info_topic, (_CAMERA_INFO_TYPE,), topics.CAMERA_INFO
        )
        self.mask_topic = self._optional("mask", mask_topic, _MASK_TYPE)
        self.truth_topic = self._optional("truth", truth_topic, _POSE_TYPE)

    def _check_files(self) -> None:
        folder = self.path
        if not folder.exists():
            raise BagError(f"bag {folder} does not exist")
        if folder.is_dir() and not (folder / "metadata.yaml").is_file():
            raise BagError(f"{folder} is not a rosbag2 folder: it has no metadata.yaml (interrupted recording?)")
        if folder.is_dir() and (folder / "metadata.yaml").stat().st_size > _MAX_METADATA_BYTES:
            raise BagError(f"{folder}/metadata.yaml is larger than {_MAX_METADATA_BYTES // 2**20} MiB")
        check_manifest(folder)
        for file in sorted(folder.glob("*.mcap")) if folder.is_dir() else [folder]:
            if file.suffix == ".mcap":
                check_mcap(file)

    @contextmanager
    def _open(self) -> Iterator[Reader]:
        with _as_bag_error(self.path), Reader(self.path) as reader:
            if reader.compression_mode:
                raise BagError(
                    f"{self.path} is compressed by {reader.compression_mode}: record it without, or convert it with "
                    f"`ros2 bag convert` (compression inside MCAP chunks is fine)"
                )
            yield reader

    def _choose(self, what: str, given: str | None, types: tuple[str, ...], *usual: str) -> str:
        fitting = sorted(name for name, kind in self._types.items() if kind in types)
        if given is not None:
            if given not in fitting:
                raise BagError(f"{self.path} has no {what} topic '{given}', it has: {', '.join(fitting) or 'none'}")
            return given
        for name in usual:
            if name in fitting:
                return name
        fitting = [name for name in fitting if name not in (topics.DETECTION_MASK,)]
        if len(fitting) == 1:
            return fitting[0]
        short = " or ".join(kind.rsplit("/", 1)[-1] for kind in types)
        if not fitting:
            raise BagError(f"{self.path} has no {what} topic ({short}), topics are: {', '.join(sorted(self._types))}")
        raise BagError(f"{self.path} has several {what} topics, choose one: {', '.join(fitting)}")

    def _optional(self, what: str, topic: str, kind: str) -> str | None:
        found = self._types.get(topic)
        if found not in (None, kind):
            raise BagError(f"{self.path}: {what} topic '{topic}' must be {kind}, found {found}")
        return topic if found and self._counts[topic] else None

    def _raw(self, topic: str) -> Iterator[tuple[bytes, str]]:
        with self._open() as reader:
            connections = [c for c in reader.connections if c.topic == topic]
            for connection, _, data in reader.messages(connections=connections):
                yield bytes(data), connection.msgtype

    def messages(self, topic: str) -> Iterator[Any]:
        """All messages of a topic, deserialized, in recorded order."""
        for data, kind in self._raw(topic):
            yield deserialize(data, kind, self.path)

    def __len__(self) -> int:
        return self._counts[self.image_topic]

    @property
    def topics(self) -> dict[str, str]:
        """Topic -> message type of everything in the bag."""
        return dict(self._types)

    @property
    def compressed(self) -> bool:
        """The images are JPEG or PNG."""
        return self._types[self.image_topic] == _IMAGE_TYPES[1]

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
    def camera(self) -> Camera:
        """The calibration; one for the whole bag."""
        camera: Camera | None = None
        for message in self.messages(self.camera_info_topic):
            try:
                found = messages.camera_from(message)
            except HatError as error:
                raise FrameError(f"{self.path}, {self.camera_info_topic}: {error}") from None
            if camera is not None and not messages.same_camera(camera, found):
                raise BagError(
                    f"{self.path}: the calibration changes at stamp {messages.stamp_of(message)}: split the bag"
                )
            camera = found
        if camera is None:
            raise BagError(f"{self.path}: topic {self.camera_info_topic} has no message: the calibration is missing")
        return camera

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
        kind, mask_kind = self._types[self.image_topic], _MASK_TYPE
        for packet in self.packets():
            try:
                rgb = decode_image(deserialize(packet.image, kind, self.path))
                mask = None if packet.mask is None else decode_mask(deserialize(packet.mask, mask_kind, self.path))
            except FrameError as error:
                raise FrameError(f"{self.path}, frame {packet.stamp_ns}: {error}") from None
            yield Frame(packet.stamp_ns, rgb, self.camera, mask)

    def packets(self) -> Iterator[Packet]:
        """The images as recorded, each with the mask of its exact stamp."""
        masks = _ByStamp(self._stamped(self.mask_topic)) if self.mask_topic else None
        for stamp_ns, data in self._stamped(self.image_topic):
            yield Packet(stamp_ns, data, self.compressed, masks.take(stamp_ns) if masks else None)

    def _stamped(self, topic: str) -> Iterator[tuple[int, bytes]]:
        for data, _ in self._raw(topic):
            yield stamp_of_cdr(data, self.path), data

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
            if not np.isfinite(row).all() or abs(np.linalg.norm(row[3:]) - 1) > 1e-3:
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
            found = next(self._stream, None)
            if found is None:
                break
            self._newest = max(self._newest, found[0])
            self._waiting[found[0]] = found[1]
        found = self._waiting.pop(stamp_ns, None)
        while len(self._waiting) > self._BEHIND:
            self._waiting.pop(min(self._waiting))
        return found


def deserialize(data: bytes, kind: str, where: Path) -> Any:
    """A message from its CDR bytes.

    Raises:
        BagError: the bytes are not a message of this type.
    """
    with _as_bag_error(where):
        return TYPESTORE.deserialize_cdr(data, kind)


def stamp_of_cdr(data: bytes, where: Path) -> int:
    """Stamp of a serialized message that starts with a std_msgs/Header (CDR, either byte order)."""
    if len(data) < 12 or data[0] != 0 or data[1] not in (0, 1):
        raise BagError(f"{where}: a message is not CDR or too short for a header ({len(data)} bytes)")
    order = "little" if data[1] else "big"
    sec = int.from_bytes(data[4:8], order, signed=True)
    return sec * 1_000_000_000 + int.from_bytes(data[8:12], order)


@contextmanager
def _as_bag_error(where: Path) -> Iterator[None]:
    """Whatever a parser of foreign bytes raises means one thing: the bag is damaged."""
    try:
        yield
    except HatError:
        raise
    except Exception as error:  # struct, YAML, sqlite, zstd, lz4 and assertion errors alike
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise BagError(f"{where} is damaged or no bag: {reason}; record or copy it again") from None


# -------------------------------------------------------------------- writing


class BagWriter:
    """Writes a rosbag2 folder (MCAP, zstd chunks); a context manager.

    The folder is complete and readable after :meth:`close`, also when a run was stopped half-way or the disk is full.

    Args:
        path: folder to create.
        frame_id: ``header.frame_id`` of images and poses.
        image_format: how :meth:`write_frame` stores images: ``raw``, ``png`` or ``jpeg``.
        jpeg_quality: 1 to 100.

    Raises:
        RunError: the folder exists already or cannot be written.
    """

    def __init__(
        self, path: str | Path, *, frame_id: str = "camera", image_format: str = "raw", jpeg_quality: int = 95
    ) -> None:
        if image_format not in ("raw", "png", "jpeg"):
            raise RunError(f"image format must be raw, png or jpeg, found '{image_format}'")
        self.path = Path(path)
        self.frame_id = frame_id
        self._format = image_format
        self._quality = jpeg_quality
        self._wire = messages.Wire.bag(TYPESTORE)
        self._connections: dict[str, Any] = {}
        if self.path.exists():
            raise RunError(f"{self.path} exists already: choose another folder or delete it")
        self._writer: Writer | None = Writer(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with _as_run_error(self.path):
            self._writer.open()
            self._file = ReservedFile(self._writer.storage.bio, self.path / RESERVE)
            self._writer.storage.bio = self._file

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write_cdr(self, topic: str, kind: str, data: bytes, log_ns: int) -> None:
        """Append a serialized message of type ``kind`` (``package/msg/Name``) at bag time ``log_ns``."""
        if self._writer is None:
            raise RunError(f"{self.path} is closed already")
        with _as_run_error(self.path):
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(topic, kind, typestore=TYPESTORE)
            self._writer.write(self._connections[topic], max(0, log_ns), data)
        if self._file.is_full:
            raise RunError(f"cannot write {self.path}: the disk is full; what was written so far is readable")

    def write_message(self, topic: str, message: Any, log_ns: int) -> None:
        """Append a message of ``rosbags``' own classes."""
        kind = message.__msgtype__
        self.write_cdr(topic, kind, bytes(TYPESTORE.serialize_cdr(message, kind)), log_ns)

    def write_frame(
        self,
        stamp_ns: int,
        image: UInt8 | bytes,
        camera: Camera,
        *,
        mask: UInt8 | None = None,
        T_cam_target: Float | None = None,
    ) -> None:
        """Append one frame: image and camera_info, and what is known of mask and truth, all with the same stamp.

        Args:
            stamp_ns: exposure stamp.
            image: (H, W, 3) uint8 RGB, or the bytes of a JPEG or PNG file, kept as they are.
            camera: calibration.
            mask: (H, W) uint8, 255 silhouette, 128 box, 0 outside.
            T_cam_target: (4, 4) true pose.
        """
        make, frame_id = self._wire, self.frame_id
        if mask is not None:
            self.write_message(topics.DETECTION_MASK, make.image(stamp_ns, frame_id, "mono8", mask), stamp_ns)
        if T_cam_target is not None:
            row = lie.row_from_matrix(T_cam_target)
            self.write_message(topics.GROUND_TRUTH, make.pose(stamp_ns, frame_id, row), stamp_ns)
        self.write_message(topics.CAMERA_INFO, make.camera_info(stamp_ns, frame_id, camera), stamp_ns)
        if isinstance(image, np.ndarray) and self._format == "raw":
            self.write_message(topics.IMAGE, make.image(stamp_ns, frame_id, "rgb8", image), stamp_ns)
            return
        data = self._encoded(image) if isinstance(image, np.ndarray) else image
        kind = "png" if data[:4] == b"\x89PNG" else "jpeg"
        self.write_message(topics.IMAGE_COMPRESSED, make.compressed(stamp_ns, frame_id, kind, data), stamp_ns)

    def _encoded(self, rgb: UInt8) -> bytes:
        bgr = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2BGR)
        if self._format == "png":
            return cv2.imencode(".png", bgr)[1].tobytes()
        return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, self._quality])[1].tobytes()

    def write_target(self, mesh: str | Path, unit_scale: float = 1.0, name: str | None = None) -> None:
        """Put a copy of the CAD model and its ``target.yaml`` into the bag's folder."""
        mesh = Path(mesh)
        content = {"mesh": mesh.name, "unit_scale": float(unit_scale), "name": name or mesh.stem}
        with _as_run_error(self.path):
            shutil.copyfile(mesh, self.path / mesh.name)
            (self.path / TARGET_FILE).write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")

    def close(self) -> None:
        """Finish the bag and write its manifest; harmless when closed already."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        with _as_run_error(self.path):
            self._file.free_reserve()
            writer.close()
            write_manifest(self.path)


@contextmanager
def _as_run_error(where: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RunError(f"cannot write {where}: {error.strerror or error}") from None
