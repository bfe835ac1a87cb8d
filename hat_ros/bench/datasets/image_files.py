"""A recording whose frames are image files: what every data set's reader builds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import Float, Float32, UInt8
from hat_ros.errors import DatasetError, FrameError
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry
from hat_ros.io.compressed import check_pixels
from hat_ros.io.value_range import ValueRange
from hat_ros.target.loading import ModelFile, find_model, load_target
from hat_ros.target.model import Target
from hat_ros.types import Camera, Frame

if TYPE_CHECKING:
    from hat_ros.bench.datasets.detections import DetectionLookup

# Sequences without a clock: 10 frames a second from one second on, so that no stamp is zero.
FIRST_STAMP_NS = 1_000_000_000
FRAME_STEP_NS = 100_000_000


@dataclass(frozen=True, eq=False)
class ImageFile:
    """One frame on disk.

    Attributes:
        stamp_ns: exposure stamp.
        image: 8-bit colour or grey image file.
        T_cam_target: (4, 4) ground truth, None when unknown.
        masks: image files of the target's visible silhouette (> 127 inside), joined; empty = none given.
        box_xyxy: (4,) detection box in pixels of the undistorted image, used when there is no mask; None = none.
    """

    stamp_ns: int
    image: Path
    T_cam_target: Float | None = None
    masks: tuple[Path, ...] = ()
    box_xyxy: Float | None = None


@dataclass(frozen=True, eq=False)
class ImageRecording:
    """Image files with one calibration.

    Attributes:
        name: for tables.
        camera: calibration of the frames handed out, without distortion.
        target_path: the CAD model.
        files: the frames in order.
        distortion: OpenCV coefficients of the files' lens; frames are undistorted to ``camera``. Empty = none.
        unit_scale: metres per unit of the CAD file.
        detections: masks and boxes computed elsewhere, on the images as stored; where given, the files' own masks and
            boxes do not count.
        mask_value: grey level of the target in the files' masks; None = all above 127.
        scene: (scene, object) numbers of a BOP data set, by which detections of many are told apart.
        image_depth: option ``camera.image_depth``, for 16-bit files.
        instance: number among several instances of one object in one scene; None = it occurs once.
        symmetry: what the data set declares of the target; None = what its ``target.yaml`` does.
        targets_only: a pose is asked for at labelled frames alone.
    """

    name: str
    camera: Camera
    target_path: Path
    files: Sequence[ImageFile]
    distortion: Float = field(default_factory=lambda: np.zeros(0))
    unit_scale: float = 1.0
    detections: DetectionLookup | None = None
    scene: tuple[int, int] | None = None
    mask_value: int | None = None
    image_depth: str = "auto"
    instance: int | None = None
    symmetry: Symmetry | None = None
    targets_only: bool = False

    def __len__(self) -> int:
        return len(self.files)

    def model_file(self) -> ModelFile:
        """The CAD file, its scale and symmetry.

        Raises:
            MeshError: it is missing or malformed.
        """
        model = find_model(self.target_path, self.unit_scale)
        return model if self.symmetry is None else replace(model, symmetry=self.symmetry)

    def load_target(self) -> Target:
        """The CAD model.

        Raises:
            MeshError: it is unusable.
        """
        target = load_target(self.target_path, self.unit_scale)
        return target if self.symmetry is None else replace(target, declared_symmetry=self.symmetry)

    def frames(self, limit: int | None = None, masks: bool = True, start: int = 0) -> Iterator[Frame]:
        """Decoded frames in order, with or without what is known of the target's place in them.

        The depth of 16-bit files is found as for a bag: it grows from frame to frame.

        Raises:
            DatasetError: a file is missing, cannot be decoded, or has another size than the calibration says.
        """
        known = ValueRange.of_option(self.image_depth)
        for item in self.files[start:limit]:
            rgb, known = read_rgb(item.image, known)
            rectified = self._rectify(rgb, item.image, cv2.INTER_LINEAR)
            mask = self.given_mask(item) if masks else None
            yield Frame(item.stamp_ns, rectified, self.camera, mask, self.is_scored(item))

    def is_scored(self, item: ImageFile) -> bool:
        """Whether a pose is asked for at a frame."""
        return not self.targets_only or item.T_cam_target is not None

    def given_mask(self, item: ImageFile) -> UInt8 | None:
        """(H, W) uint8 as in ``Frame.given_mask``, None when the frame brings no detection at all."""
        if self.detections is not None:
            mask = self.detections.given_mask(item.image.name, (self.camera.height, self.camera.width))
            return None if mask is None else self._rectify(mask, item.image, cv2.INTER_NEAREST)
        if item.masks:
            inside = np.zeros((self.camera.height, self.camera.width), bool)
            for path in item.masks:
                levels = self._rectify(_read(path, cv2.IMREAD_GRAYSCALE), path, cv2.INTER_NEAREST)
                inside |= levels > 127 if self.mask_value is None else levels == self.mask_value
            return inside.astype(np.uint8) * np.uint8(255)
        if item.box_xyxy is not None:
            mask = np.zeros((self.camera.height, self.camera.width), np.uint8)
            x0, y0 = np.clip(np.ceil(item.box_xyxy[:2]), 0, None).astype(int)
            x1, y1 = np.clip(np.floor(item.box_xyxy[2:]) + 1, 0, None).astype(int)
            mask[y0:y1, x0:x1] = 128
            return mask
        return None

    def truth(self) -> dict[int, Float]:
        """Stamp -> (4, 4) ``T_cam_target`` of the labelled frames."""
        return {item.stamp_ns: item.T_cam_target for item in self.files if item.T_cam_target is not None}

    @cached_property
    def _maps(self) -> tuple[Float32, Float32]:
        size = (self.camera.width, self.camera.height)
        K = self.camera.K
        x, y = cv2.initUndistortRectifyMap(K, self.distortion, None, K, size, cv2.CV_32FC1)
        return np.asarray(x, np.float32), np.asarray(y, np.float32)

    def _rectify(self, image: UInt8, path: Path, interpolation: int) -> UInt8:
        if image.shape[:2] != (self.camera.height, self.camera.width):
            raise DatasetError(
                f"{path}: image is {image.shape[1]}x{image.shape[0]}, "
                f"the calibration says {self.camera.width}x{self.camera.height}"
            )
        if not self.distortion.any():
            return image
        return np.asarray(cv2.remap(image, *self._maps, interpolation), np.uint8)


def read_rgb(path: Path, known: ValueRange) -> tuple[UInt8, ValueRange]:
    """(H, W, 3) uint8 RGB of an image file, grey repeated, and what is known of its range of values after it.

    Raises:
        DatasetError: missing, not an image, or of other than 8 or 16 bits per value.
    """
    bgr = _decoded(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if bgr.dtype == np.uint16:
        bgr, known = known.narrow(bgr.astype(np.uint16, copy=False))
    if bgr.dtype != np.uint8:
        raise DatasetError(f"{path}: an image must have 8 or 16 bits per value, found {bgr.dtype}")
    return np.asarray(cv2.cvtColor(np.asarray(bgr, np.uint8), cv2.COLOR_BGR2RGB), np.uint8), known


def _read(path: Path, flags: int) -> UInt8:
    """An image file in 8 bits."""
    return np.asarray(_decoded(path, flags), np.uint8)


def _decoded(path: Path, flags: int) -> NDArray[np.generic]:
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        check_pixels(data.tobytes())
    except FrameError as error:
        raise DatasetError(f"{path}: {error}; copy the data set again") from None
    # Bits per channel and EXIF rotation as stored: labels refer to the stored pixels.
    image = cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    if image is None:
        raise DatasetError(f"{path}: not an image that can be decoded; copy the data set again")
    return np.asarray(image)


def pose_from_label(quat: object, translation_m: object, order: str, where: str) -> Float:
    """(4, 4) ``T_cam_target`` from a label with ``p_cam = R(q) p + t``.

    Args:
        quat: four numbers in the given order, as they stand in the file; normalised here.
        translation_m: three numbers, likewise.
        order: ``wxyz`` or ``xyzw``.
        where: for the error: file and entry.

    Raises:
        DatasetError: wrong counts, not numbers, not finite, or a quaternion far from unit length.
    """
    try:
        q, t = np.array(quat, dtype=np.float64), np.array(translation_m, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DatasetError(f"{where}: pose label is not made of numbers: {quat}, {translation_m}") from None
    if q.shape != (4,) or t.shape != (3,) or not (np.isfinite(q).all() and np.isfinite(t).all()):
        raise DatasetError(f"{where}: pose label needs 4 + 3 finite numbers, found {q.tolist()} and {t.tolist()}")
    if abs(math.hypot(*q) - 1.0) > 0.01:
        raise DatasetError(f"{where}: quaternion has length {math.hypot(*q):.4f}, expected 1")
    return lie.transform(lie.matrix_from_quat(q[[1, 2, 3, 0]] if order == "wxyz" else q), t)


def camera_from_label(K: object, size: Sequence[Any], where: str) -> Camera:
    """Camera of a data set that gives K and [width, height].

    A principal point of exactly half the image size counts from the image corner (renderers do): it is moved by half
    a pixel to our convention of integer pixel centres. Any other value comes from a calibration and is kept.

    Raises:
        DatasetError: not a camera matrix, or no image size.
    """
    try:
        matrix = np.array(K, dtype=np.float64).reshape(3, 3)
        width, height = (int(value) for value in size)
        if matrix[0, 2] == width / 2 and matrix[1, 2] == height / 2:
            matrix[:2, 2] -= 0.5
        return Camera(matrix, width, height)
    except (TypeError, ValueError, FrameError) as error:
        raise DatasetError(f"{where}: camera matrix 3x3 and image size expected ({error})") from None


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file.

    Raises:
        DatasetError: missing or not an image.
    """
    height, width = _read(path, cv2.IMREAD_UNCHANGED).shape[:2]
    return width, height


def stamp_of(index: int) -> int:
    """Stamp of frame ``index`` in a sequence without a clock."""
    return FIRST_STAMP_NS + index * FRAME_STEP_NS
