"""SPEED and SPEED+: single images of Tango with poses; also SPEED-UE-Cube and others of the same layout.

    ROOT/camera.json                     cameraMatrix, distCoeffs, Nu, Nv (SPEED: fx, fy, ppx, ppy in metres, see below)
    ROOT/synthetic/images/*.jpg          ROOT/synthetic/train.json, validation.json: [{filename, q_vbs2tango_true
    ROOT/lightbox/images/*.jpg           ROOT/lightbox/test.json      (scalar first), r_Vo2To_vbs_true (m)}]
    ROOT/images/train/*.jpg              ROOT/train.json: SPEED, whose labels are called q_vbs2tango and r_Vo2To_vbs_m

``p_cam = R(q) p + r``. The images do not follow one another: track them with ``--mode independent``.
Layouts: https://purl.stanford.edu/wv398fc4383 (SPEED+), https://purl.stanford.edu/dz692fn7184 (SPEED).
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.datasets.image_files import (
    ImageFile,
    ImageRecording,
    camera_from_label,
    image_size,
    pose_from_label,
    stamp_of,
)
from hat_ros.bench.datasets.sequence import named_in, read_json
from hat_ros.bench.datasets.shirt import opencv_distortion
from hat_ros.errors import DatasetError

LOG = logging.getLogger(__name__)

LISTS = ("train", "validation", "test")
_QUATERNIONS = ("q_vbs2tango_true", "q_vbs2tango")
_POSITIONS = ("r_Vo2To_vbs_true", "r_Vo2To_vbs_m")
# The camera of SPEED as published with the data set: 1920x1200 px of 5.86 um, lens of 17.6 mm.
_SPEED_K = ((0.0176 / 5.86e-6, 0.0, 960.0), (0.0, 0.0176 / 5.86e-6, 600.0), (0.0, 0.0, 1.0))
_SPEED_SIZE = (1920, 1200)


def open_speed(root: Path, model: Path | None = None, sequences: Collection[str] = ()) -> Iterator[ImageRecording]:
    """One recording for each list of labels: ``train``, ``synthetic_validation``, ``lightbox_test``, ...

    Args:
        root: the data set's folder, or one of its domains with ``camera.json`` in it or above it.
        model: CAD model in metres; required, the data set brings none.
        sequences: names to keep, empty = all.

    Raises:
        DatasetError: missing folders, malformed files.
    """
    if model is None:
        raise DatasetError("speed: name the CAD model with --model, the data set brings none")
    lists = [path for name in LISTS for path in (root / f"{name}.json", *sorted(root.glob(f"*/{name}.json")))]
    lists = [path for path in lists if path.is_file()]
    if not lists:
        raise DatasetError(
            f"{root}: no {', '.join(f'{name}.json' for name in LISTS)}, neither here nor one folder below"
        )
    camera_path = next((p for p in (root / "camera.json", root.parent / "camera.json") if p.is_file()), None)
    for path in lists:
        name = path.stem if path.parent == root else f"{path.parent.name}_{path.stem}"
        if sequences and name not in sequences:
            continue
        files = _files(path)
        if not files:
            LOG.warning("%s: none of its images is there, it is left out", path)
            continue
        K, size, distortion = _calibration(camera_path)
        if size is None:
            size = image_size(files[0].image)
        camera = camera_from_label(K, size, str(camera_path or "speed"))
        LOG.info("%s: single images, not a film: track them with --mode independent", name)
        yield ImageRecording(name, camera, model, files, distortion)


def _calibration(path: Path | None) -> tuple[Any, tuple[Any, Any] | None, Float]:
    """K, [width, height] and distortion; those of SPEED where there is no file."""
    if path is None:
        return _SPEED_K, _SPEED_SIZE, np.zeros(0)
    labels = read_json(path)
    if isinstance(labels, dict) and "cameraMatrix" in labels:
        size = (labels.get("Nu"), labels.get("Nv")) if "Nu" in labels else None
        return labels["cameraMatrix"], size, opencv_distortion(labels.get("distCoeffs", []), path)
    try:
        f = [float(labels[key]) / float(labels[pitch]) for key, pitch in (("fx", "ppx"), ("fy", "ppy"))]
        size = int(labels["Nu"]), int(labels["Nv"])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        raise DatasetError(f"{path}: expected cameraMatrix, distCoeffs, Nu and Nv") from None
    return ((f[0], 0, size[0] / 2), (0, f[1], size[1] / 2), (0, 0, 1)), size, np.zeros(0)


def _files(path: Path) -> list[ImageFile]:
    """The labelled images that are there; a public copy often holds a part of them."""
    labels = read_json(path)
    if not isinstance(labels, list) or not labels:
        raise DatasetError(f"{path}: expected a non-empty list of labels")
    folders = [path.parent / "images" / path.stem, path.parent / "images", path.parent]
    files, missing = [], 0
    for index, entry in enumerate(labels):
        where = f"{path}, entry {index}"
        if not isinstance(entry, dict) or not isinstance(entry.get("filename"), str):
            raise DatasetError(f"{where}: expected a mapping with 'filename'")
        name = named_in(folders[0], entry["filename"], where).name
        image = next((folder / name for folder in folders if (folder / name).is_file()), None)
        if image is None:
            missing += 1
            continue
        files.append(ImageFile(stamp_of(index), image, _pose(entry, where)))
    if missing and files:
        LOG.warning("%s: %d of its %d images are not there and are left out", path, missing, len(labels))
    return files


def _pose(entry: dict[str, Any], where: str) -> Float | None:
    """The true pose; None for a list without labels."""
    quat = next((entry[key] for key in _QUATERNIONS if key in entry), None)
    position = next((entry[key] for key in _POSITIONS if key in entry), None)
    return None if quat is None and position is None else pose_from_label(quat, position, "wxyz", where)
