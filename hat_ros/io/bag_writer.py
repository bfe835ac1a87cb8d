"""Writes recordings: a rosbag2 folder of frames with what is known of them, and the target's CAD model.

A bag of ours is a folder ``NAME/`` with ``metadata.yaml``, ``NAME.mcap``, ``target.yaml`` and the mesh that it names,
and ``manifest.json`` with the SHA-256 of each, because neither MCAP's optional checksums nor ``rosbags`` notice every
flipped bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import yaml

from hat_ros.array_types import Float, UInt8
from hat_ros.errors import RunError
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry, declaration_of
from hat_ros.io import messages, topics
from hat_ros.io.images import encode_image
from hat_ros.io.lens import Lens
from hat_ros.io.manifest import TARGET_FILE, write_manifest
from hat_ros.io.mcap_folder import McapFolder
from hat_ros.io.rosbag import TYPESTORE
from hat_ros.target.mesh_file import copy_model
from hat_ros.types import Camera

IMAGE_FORMATS = ("raw", "png", "jpeg")


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
        if image_format not in IMAGE_FORMATS:
            raise RunError(f"image format must be {', '.join(IMAGE_FORMATS)}, found '{image_format}'")
        self.path = Path(path)
        self.frame_id = frame_id
        self.closed = False
        self._format = image_format
        self._quality = jpeg_quality
        self._wire = messages.Wire.bag(TYPESTORE)
        if self.path.exists():
            raise RunError(f"{self.path} exists already: choose another folder or delete it")
        with _as_run_error(self.path):
            self._folder = McapFolder(self.path)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write_cdr(self, topic: str, kind: str, data: bytes, log_ns: int) -> None:
        """Append a serialized message of type ``kind`` (``package/msg/Name``) at bag time ``log_ns``.

        Raises:
            RunError: the bag is closed, or the disk is full.
        """
        if self.closed:
            raise RunError(f"{self.path} is closed already")
        with _as_run_error(self.path):
            self._folder.write(topic, kind, data, max(0, log_ns))
        if self._folder.is_full:
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
        lens: Lens | None = None,
    ) -> None:
        """Append one frame: image and camera_info, and what is known of mask and truth, all with the same stamp.

        Args:
            stamp_ns: exposure stamp.
            image: (H, W, 3) uint8 RGB, or the bytes of a JPEG or PNG file, kept as they are.
            camera: calibration.
            mask: (H, W) uint8, 255 silhouette, 128 box, 0 outside.
            T_cam_target: (4, 4) true pose.
            lens: distortion of the image; None = it has none.
        """
        make, frame_id = self._wire, self.frame_id
        if mask is not None:
            self.write_message(topics.DETECTION_MASK, make.image(stamp_ns, frame_id, "mono8", mask), stamp_ns)
        if T_cam_target is not None:
            row = lie.row_from_matrix(T_cam_target)
            self.write_message(topics.GROUND_TRUTH, make.pose(stamp_ns, frame_id, row), stamp_ns)
        self.write_message(topics.CAMERA_INFO, make.camera_info(stamp_ns, frame_id, camera, lens), stamp_ns)
        if not isinstance(image, bytes) and self._format == "raw":
            self.write_message(topics.IMAGE, make.image(stamp_ns, frame_id, "rgb8", image), stamp_ns)
            return
        data = image if isinstance(image, bytes) else encode_image(image, self._format, self._quality)
        kind = "png" if data[:4] == b"\x89PNG" else "jpeg"
        self.write_message(topics.IMAGE_COMPRESSED, make.compressed(stamp_ns, frame_id, kind, data), stamp_ns)

    def write_target(
        self,
        mesh: str | Path,
        unit_scale: float = 1.0,
        name: str | None = None,
        symmetry: Symmetry | None = None,
        T_label_cad: Float | None = None,
    ) -> None:
        """Put a copy of the CAD model, of what it names beside it, and a ``target.yaml`` into the bag's folder.

        Args:
            mesh: the model's file.
            unit_scale: metres per unit of the file.
            name: name of the target, by default that of the file.
            symmetry: what is declared of it; None = nothing.
            T_label_cad: (4, 4) from the file's axes to those of the poses; None = the same.
        """
        mesh = Path(mesh)
        with _as_run_error(self.path):
            copy = copy_model(mesh, self.path)
            content: dict[str, Any] = {"mesh": copy, "unit_scale": float(unit_scale), "name": name or mesh.stem}
            content |= {} if symmetry is None else declaration_of(symmetry)
            if T_label_cad is not None and not np.array_equal(T_label_cad, np.eye(4)):
                content["T_label_cad"] = T_label_cad.tolist()
            (self.path / TARGET_FILE).write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")

    def close(self) -> None:
        """Finish the bag and write its manifest; harmless when closed already."""
        if self.closed:
            return
        self.closed = True
        with _as_run_error(self.path):
            self._folder.close()
            write_manifest(self.path)


@contextmanager
def _as_run_error(where: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RunError(f"cannot write {where}: {error.strerror or error}") from None
