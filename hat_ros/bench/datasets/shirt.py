"""SHIRT: two rendezvous trajectories (roe1, roe2), each synthetic and from the lightbox laboratory.

    ROOT/camera.json                     cameraMatrix, distCoeffs, Nu, Nv
    ROOT/roe1/roe1.json                  [{filename, q_vbs2tango_true (scalar first), r_Vo2To_vbs_true (m)}]
    ROOT/roe1/synthetic/images/*.jpg     also without the inner folder 'images'

``p_cam = R(q) p + r``. The lens distortion is taken out of the images on import; the camera matrix stays.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.datasets.image_files import ImageFile, ImageRecording, camera_from_label, pose_from_label, stamp_of
from hat_ros.bench.datasets.sequence import named_in, read_json
from hat_ros.errors import DatasetError

TRAJECTORIES = ("roe1", "roe2")
DOMAINS = ("synthetic", "lightbox")


def open_shirt(root: Path, model: Path | None = None, sequences: Collection[str] = ()) -> Iterator[ImageRecording]:
    """Recordings ``roe1_synthetic`` ... of a SHIRT folder.

    Args:
        root: folder with ``camera.json``.
        model: CAD model in metres; required, the data set brings none.
        sequences: names to keep, empty = all that are there.

    Raises:
        DatasetError: missing folders, malformed files.
    """
    if model is None:
        raise DatasetError("shirt: name the CAD model with --model, the data set brings none")
    camera_path = root / "camera.json"
    calibration = read_json(camera_path)
    if not isinstance(calibration, dict) or "cameraMatrix" not in calibration:
        raise DatasetError(f"{camera_path}: expected cameraMatrix, distCoeffs, Nu and Nv")
    size = (calibration.get("Nu"), calibration.get("Nv"))
    camera = camera_from_label(calibration["cameraMatrix"], size, str(camera_path))
    distortion = opencv_distortion(calibration.get("distCoeffs", []), camera_path)
    found = False
    for trajectory in TRAJECTORIES:
        for domain in DOMAINS:
            name, folder = f"{trajectory}_{domain}", root / trajectory / domain
            if not folder.is_dir() or (sequences and name not in sequences):
                continue
            found = True
            images = folder / "images" if (folder / "images").is_dir() else folder
            yield ImageRecording(name, camera, model, _files(root / trajectory, images), distortion)
    if not found:
        raise DatasetError(f"{root}: no folder like roe1/synthetic; give the folder that holds camera.json and roe1")


def opencv_distortion(values: Any, path: Path) -> Float:
    """Coefficients from ``camera.json``, in OpenCV's order.

    Raises:
        DatasetError: not 4, 5, 8, 12 or 14 numbers.
    """
    try:
        coefficients = np.array(values, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        raise DatasetError(f"{path}: distCoeffs must be a list of numbers, found {values!r}") from None
    if coefficients.size not in (0, 4, 5, 8, 12, 14) or not np.isfinite(coefficients).all():
        raise DatasetError(f"{path}: distCoeffs must be 4, 5, 8, 12 or 14 numbers (OpenCV), found {values!r}")
    return coefficients


def _files(trajectory: Path, images: Path) -> list[ImageFile]:
    path = trajectory / f"{trajectory.name}.json"
    labels = read_json(path)
    if not isinstance(labels, list) or not labels:
        raise DatasetError(f"{path}: expected a non-empty list of labels")
    files = []
    for index, entry in enumerate(labels):
        where = f"{path}, entry {index}"
        if not isinstance(entry, dict) or not isinstance(entry.get("filename"), str):
            raise DatasetError(f"{where}: expected a mapping with 'filename'")
        image = named_in(images, entry["filename"], where)
        if not image.is_file():
            raise DatasetError(f"{where}: image {image} does not exist")
        pose = pose_from_label(entry.get("q_vbs2tango_true"), entry.get("r_Vo2To_vbs_true"), "wxyz", where)
        files.append(ImageFile(stamp_of(index), image, pose))
    return files
