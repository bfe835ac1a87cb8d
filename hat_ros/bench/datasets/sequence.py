"""The ``sequence`` layout: a folder of images, masks, a CAD model and ``labels.json``.

    images/000000.jpg ...   8-bit RGB
    masks/000000.png ...    optional, 255 = visible target
    target.glb | ...        metric CAD
    labels.json             K, size, mesh, scale, kind, frames: file, q_wxyz_cam_from_target, t_cam_from_target_m

``p_cam = R(q) p_target + t``, OpenCV camera, pixel centres at integer coordinates, no distortion. The layout carries
no stamps; frames are 0.1 s apart.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.datasets.image_files import ImageFile, ImageRecording, pose_from_label, stamp_of
from hat_ros.errors import DatasetError, FrameError
from hat_ros.geometry import lie
from hat_ros.target.loading import find_model
from hat_ros.target.units import AUTO
from hat_ros.types import Camera

# What file systems take.
_MAX_NAME_BYTES, _MAX_PATH_BYTES = 255, 1024


def load_sequence(folder: str | Path) -> ImageRecording:
    """Open a clip of the ``sequence`` layout; images are decoded as they are asked for.

    Raises:
        DatasetError: the folder or ``labels.json`` is missing or malformed.
    """
    folder = Path(folder)
    labels_path = folder / "labels.json"
    labels = read_json(labels_path)
    if not isinstance(labels, dict) or not isinstance(labels.get("frames"), list) or not labels["frames"]:
        raise DatasetError(f"{labels_path}: expected a mapping with a non-empty list 'frames'")
    camera = _camera(labels, labels_path)
    mesh = named_in(folder, str(labels.get("mesh", "")), f"{labels_path}: 'mesh'")
    if not mesh.is_file():
        raise DatasetError(f"{labels_path}: the CAD model 'mesh' names {mesh.name!r}, which is not in the folder")
    scale = labels.get("scale", 1.0)
    if scale == AUTO:
        scale = find_model(mesh, None).unit_scale
    if isinstance(scale, bool) or not isinstance(scale, (int, float)):
        raise DatasetError(f"{labels_path}: 'scale' must be a number or '{AUTO}', found {scale!r}")
    files = [_file(folder, labels_path, entry, index) for index, entry in enumerate(labels["frames"])]
    return ImageRecording(folder.name, camera, mesh, files, unit_scale=float(scale))


def write_labels(
    folder: Path, camera: Camera, mesh: str, kind: str, poses: Float, names: list[str], unit_scale: float = 1.0
) -> None:
    """Write ``labels.json``: (N, 4, 4) ``T_cam_target`` poses of the named images, metres per unit of the CAD file."""
    frames = [
        {
            "file": name,
            "q_wxyz_cam_from_target": lie.quat_from_matrix(T[:3, :3])[[3, 0, 1, 2]].tolist(),
            "t_cam_from_target_m": T[:3, 3].tolist(),
        }
        for name, T in zip(names, poses, strict=True)
    ]
    labels = {
        "K": camera.K.tolist(),
        "size": [camera.width, camera.height],
        "mesh": mesh,
        "scale": unit_scale,
        "kind": kind,
        "frames": frames,
    }
    (folder / "labels.json").write_text(json.dumps(labels), encoding="utf-8")


def read_json(path: Path) -> Any:
    """Parsed JSON file.

    Raises:
        DatasetError: missing or malformed.
    """
    if path.exists() and not path.is_file():
        raise DatasetError(f"{path}: is not a file")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: not valid JSON ({error})") from None


def named_in(folder: Path, name: str, where: str) -> Path:
    """The file of a folder that a label names; it is copied into bags, so it must not lead out of the folder.

    Raises:
        DatasetError: an absolute path, one with ``..``, or one that is too long for any file.
    """
    sizes = [len(part.encode("utf-8", "replace")) for part in Path(name).parts]
    if max(sizes, default=0) > _MAX_NAME_BYTES or sum(sizes) + len(sizes) > _MAX_PATH_BYTES:
        raise DatasetError(f"{where}: {name[:80]!r}... is too long for the name of a file")
    if Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
        raise DatasetError(f"{where}: {name[:80]!r} leads out of {folder}: name a file in that folder")
    return folder / name


def _camera(labels: dict[str, Any], path: Path) -> Camera:
    try:
        width, height = (int(value) for value in labels["size"])
        return Camera(np.array(labels["K"], dtype=np.float64), width, height)
    except (KeyError, TypeError, ValueError, OverflowError, FrameError) as error:
        raise DatasetError(f"{path}: 'K' must be 3x3 and 'size' [width, height] ({error})") from None


def _file(folder: Path, labels_path: Path, entry: Any, index: int) -> ImageFile:
    where = f"{labels_path}, frame {index}"
    if not isinstance(entry, dict) or not isinstance(entry.get("file"), str):
        raise DatasetError(f"{where}: expected a mapping with 'file'")
    image = named_in(folder / "images", entry["file"], where)
    if not image.is_file():
        raise DatasetError(f"{where}: image {image.name!r} is not in the folder 'images'")
    T_cam_target = None
    if "q_wxyz_cam_from_target" in entry:
        T_cam_target = pose_from_label(entry["q_wxyz_cam_from_target"], entry.get("t_cam_from_target_m"), "wxyz", where)
    mask = folder / "masks" / f"{Path(entry['file']).stem}.png"
    return ImageFile(stamp_of(index), image, T_cam_target, (mask,) if mask.is_file() else ())


def open_sequences(
    folder: Path, model: Path | None = None, sequences: Collection[str] = ()
) -> Iterator[ImageRecording]:
    """The one clip of a ``sequence`` folder, for the importer; ``model`` replaces its CAD model (same unit scale).

    Raises:
        DatasetError: see :func:`load_sequence`.
    """
    recording = load_sequence(folder)
    if not sequences or recording.name in sequences:
        yield recording if model is None else replace(recording, target_path=model)
