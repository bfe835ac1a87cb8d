"""Calibrations from files: the YAML of ROS' ``camera_calibration``, or a CameraInfo message as text."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.config.yaml_text import read_yaml
from hat_ros.errors import ConfigError, DatasetError, FrameError
from hat_ros.io.lens import Lens
from hat_ros.types import Camera

# Of each entry: its name in the calibration file, and in the message.
_WIDTH, _HEIGHT = ("image_width", "width"), ("image_height", "height")
_K, _P, _D = ("camera_matrix", "k", "K"), ("projection_matrix", "p", "P"), ("distortion_coefficients", "d", "D")


@dataclass(frozen=True, eq=False)
class CameraFile:
    """A calibration.

    Attributes:
        camera: the pinhole camera; its size is that of the images.
        lens: distortion of the images; None = they have none.
    """

    camera: Camera
    lens: Lens | None


def read_camera_file(path: Path, rectified: bool = False) -> CameraFile:
    """Read a calibration.

    Args:
        path: YAML with ``image_width``, ``image_height``, ``camera_matrix`` and, if the lens distorts,
            ``distortion_model`` and ``distortion_coefficients``; or with ``width``, ``height``, ``k``, ``d``.
        rectified: the images are rectified: ``projection_matrix`` (``p``) describes them, and they have no distortion.

    Raises:
        DatasetError: unreadable, or an entry is missing or impossible.
    """
    try:
        data = read_yaml(path)
    except ConfigError as error:
        raise DatasetError(str(error)) from None
    if not isinstance(data, dict):
        raise DatasetError(f"{path}: expected image_width, image_height and camera_matrix")
    width, height = (_numbers(data, names, 1, path)[0] for names in (_WIDTH, _HEIGHT))
    K = _numbers(data, _P, 12, path).reshape(3, 4)[:, :3] if rectified else _numbers(data, _K, 9, path).reshape(3, 3)
    d = np.zeros(0) if rectified or not any(name in data for name in _D) else _numbers(data, _D, None, path)
    try:
        camera = Camera(K, int(width), int(height))
        lens = Lens.of(str(data.get("distortion_model", "")), d, camera) if d.any() else None
    except FrameError as error:
        raise DatasetError(f"{path}: {error}") from None
    return CameraFile(camera, lens)


def _numbers(data: dict[str, Any], names: tuple[str, ...], count: int | None, path: Path) -> Float:
    value = next((data[name] for name in names if name in data), None)
    if isinstance(value, dict):  # rows, cols, data
        value = value.get("data")
    try:
        numbers = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        numbers = np.full(1, np.nan)
    if not np.isfinite(numbers).all() or (count is not None and len(numbers) != count):
        raise DatasetError(f"{path}: {names[0]} must be {count or 'a list of'} finite numbers, found {value!r}")
    return numbers
