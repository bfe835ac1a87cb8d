"""``hat import video`` and ``hat import images``: recordings without ground truth from films and folders of images."""

from __future__ import annotations

import logging
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.bench.datasets.calibration_file import CameraFile, read_camera_file
from hat_ros.bench.datasets.image_files import FIRST_STAMP_NS, image_size
from hat_ros.errors import DatasetError, FrameError, UsageError
from hat_ros.io.bag_writer import BagWriter
from hat_ros.io.compressed import check_pixels
from hat_ros.target.loading import find_model, load_target
from hat_ros.types import Camera

LOG = logging.getLogger(__name__)

KINDS = ("video", "images")
DEFAULT_FPS = 10.0
_FPS_RANGE = (1e-3, 1e4)
_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
_FLAGS = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
# Kept byte for byte in the bag; everything else is decoded and stored as PNG.
_AS_IS = (".png", ".jpg", ".jpeg")

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Footage:
    """Where a recording is, and what is known of its camera.

    Attributes:
        kind: ``video`` or ``images``.
        source: the film, or the folder.
        model: CAD file or ``target.yaml``.
        intrinsics: fx, fy, cx, cy in pixels; None = ``camera_file`` says them.
        camera_file: see :func:`hat_ros.bench.datasets.calibration_file.read_camera_file`.
        rectified: the images are rectified, see there.
        fps: images per second; None = what the film says, 10 for a folder.
        unit_scale: metres per unit of the CAD file; None = guessed.
    """

    kind: str
    source: Path
    model: Path
    intrinsics: Sequence[float] | None = None
    camera_file: Path | None = None
    rectified: bool = False
    fps: float | None = None
    unit_scale: float | None = 1.0


def import_footage(footage: Footage, out: str | Path, progress: Progress | None = None) -> Path:
    """Write a bag: images, calibration with its distortion coefficients, CAD model.

    Args:
        footage: what to import.
        out: bag to write.
        progress: called with (name, frames done, frames in all).

    Returns:
        ``out``, complete.

    Raises:
        UsageError: ``out`` exists, or the calibration is given twice or not at all.
        DatasetError: nothing that can be decoded, or images of another size than the calibration.
        MeshError: the CAD model is bad.
        RunError: the bag cannot be written.
    """
    out = Path(out)
    if out.exists():
        raise UsageError(f"{out} exists already; choose another --out or remove it")
    if (footage.intrinsics is None) == (footage.camera_file is None):
        raise UsageError("give the calibration once: --K FX FY CX CY or --camera FILE")
    if footage.fps is not None and not _FPS_RANGE[0] <= footage.fps <= _FPS_RANGE[1]:
        raise UsageError(f"--fps must be between {_FPS_RANGE[0]:g} and {_FPS_RANGE[1]:g}, found {footage.fps}")
    model = find_model(footage.model, footage.unit_scale)
    load_target(model.mesh, model.unit_scale)  # a bad CAD model is found before the long part
    reader = _Film(footage) if footage.kind == "video" else _Folder(footage)
    calibration = _calibration(footage, reader.size)
    partial = out.with_name(f"{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    count = 0
    with BagWriter(partial / out.name, image_format="png") as writer:
        for count, (stamp_ns, image, size) in enumerate(reader.frames(), start=1):
            _check_size(size, calibration.camera, f"{footage.source}, image {count}")
            writer.write_frame(stamp_ns, image, calibration.camera, lens=calibration.lens)
            if progress is not None:
                progress(out.name, count, max(count, reader.count))
        writer.write_target(model.mesh, model.unit_scale, model.name, model.symmetry, model.T_label_cad)
    if not count:
        shutil.rmtree(partial)
        raise DatasetError(f"{footage.source}: holds no image that can be decoded")
    (partial / out.name).rename(out)
    partial.rmdir()
    return out


def _calibration(footage: Footage, size: tuple[int, int]) -> CameraFile:
    """The calibration; ``size`` is that of the first image, which a bare ``--K`` belongs to."""
    if footage.camera_file is not None:
        calibration = read_camera_file(footage.camera_file, footage.rectified)
        _check_size(size, calibration.camera, str(footage.source))
        return calibration
    fx, fy, cx, cy = footage.intrinsics or ()
    if not (0 <= cx < size[0] and 0 <= cy < size[1]):
        LOG.warning(
            "--K: the principal point (%g, %g) lies outside the images of %dx%d px; is it that of another size?",
            cx,
            cy,
            *size,
        )
    try:
        return CameraFile(Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), *size), None)
    except FrameError as error:
        raise UsageError(f"--K: {error}") from None


def _check_size(size: tuple[int, int], camera: Camera, where: str) -> None:
    if size != (camera.width, camera.height):
        raise DatasetError(
            f"{where}: {size[0]}x{size[1]} px, the calibration is for {camera.width}x{camera.height}: scale the one to "
            f"the other"
        )


class _Folder:
    """Images of a folder in the order of the numbers in their names."""

    def __init__(self, footage: Footage) -> None:
        if not footage.source.is_dir():
            raise DatasetError(f"{footage.source}: no such folder of images")
        found = [path for path in footage.source.iterdir() if path.suffix.lower() in _SUFFIXES and path.is_file()]
        if not found:
            raise DatasetError(f"{footage.source}: no image ({', '.join(_SUFFIXES)}) in this folder")
        self._paths = sorted(found, key=lambda path: _natural(path.name))
        self._step_ns = 1e9 / (footage.fps or DEFAULT_FPS)
        self.count = len(found)
        self.size = image_size(self._paths[0])

    def frames(self) -> Iterator[tuple[int, bytes | UInt8, tuple[int, int]]]:
        """Stamp, bytes or RGB pixels, and (width, height) of each image."""
        for index, path in enumerate(self._paths):
            data = path.read_bytes()
            try:
                check_pixels(data)
            except FrameError as error:
                raise DatasetError(f"{path}: {error}; remove or replace it") from None
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), _FLAGS) if data else None
            if pixels is None:
                raise DatasetError(f"{path}: not an image that can be decoded; remove or replace it")
            size = (pixels.shape[1], pixels.shape[0])
            if path.suffix.lower() in _AS_IS:
                yield FIRST_STAMP_NS + round(index * self._step_ns), data, size
                continue
            if pixels.dtype != np.uint8:
                raise DatasetError(f"{path}: {pixels.dtype} values per channel; save it as a PNG")
            yield FIRST_STAMP_NS + round(index * self._step_ns), np.ascontiguousarray(pixels[..., ::-1], np.uint8), size


class _Film:
    """Frames of a film, at its own times unless a rate is given."""

    def __init__(self, footage: Footage) -> None:
        if not footage.source.is_file():
            raise DatasetError(f"{footage.source}: no such film")
        self._source, self._fps = footage.source, footage.fps
        film = self._opened()
        self.count = max(0, int(film.get(cv2.CAP_PROP_FRAME_COUNT)))
        stated = film.get(cv2.CAP_PROP_FPS)
        self._stated_fps = stated if _FPS_RANGE[0] <= stated <= _FPS_RANGE[1] else DEFAULT_FPS
        decoded, first = film.read()
        film.release()
        if not decoded:
            raise DatasetError(f"{footage.source}: not a film that can be decoded; convert it, for example to H.264")
        self.size = (first.shape[1], first.shape[0])

    def frames(self) -> Iterator[tuple[int, bytes | UInt8, tuple[int, int]]]:
        """Stamp, RGB pixels and (width, height) of each frame."""
        film, index, last_ns = self._opened(), 0, -1
        while True:
            at_ms = film.get(cv2.CAP_PROP_POS_MSEC)
            decoded, bgr = film.read()
            if not decoded:
                break
            at_ns = round(index * 1e9 / (self._fps or self._stated_fps))
            if self._fps is None and np.isfinite(at_ms) and round(at_ms * 1e6) > last_ns:
                at_ns = round(at_ms * 1e6)
            last_ns = max(at_ns, last_ns + 1)
            rgb = np.ascontiguousarray(bgr[..., ::-1], np.uint8)
            yield FIRST_STAMP_NS + last_ns, rgb, (rgb.shape[1], rgb.shape[0])
            index += 1
        film.release()
        if index < self.count:
            LOG.warning("%s: %d of the %d frames that it declares can be decoded", self._source, index, self.count)

    def _opened(self) -> cv2.VideoCapture:
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # it writes to stderr what the sentence says
        film = cv2.VideoCapture(str(self._source), cv2.CAP_FFMPEG)
        if not film.isOpened():
            raise DatasetError(f"{self._source}: not a film that can be decoded; convert it, for example to H.264")
        return film


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key by which img2 stands before img10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
