"""YCB-Video as it was published: one file of each kind per frame, poses in MATLAB files.

    ROOT/data/0048/000001-color.png (or .jpg)
    ROOT/data/0048/000001-label.png      per pixel the class of the object, 1 to 21
    ROOT/data/0048/000001-meta.mat       cls_indexes, poses (3, 4, n) m, intrinsic_matrix, factor_depth
    ROOT/models/003_cracker_box/textured.obj   or textured_simple.obj, points.xyz; metres

Single folders of such frames, as they lie in many public copies, are read too. Each object of a folder is a recording
of its own, ``FOLDER_objCLASS`` or, in a bare folder, ``objCLASS``. Stamps follow the numbers of the frames at 0.1 s.
Layout: https://rse-lab.cs.washington.edu/projects/posecnn/
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from hat_ros.array_types import Float
from hat_ros.bench.datasets.image_files import ImageFile, ImageRecording, camera_from_label, image_size, stamp_of
from hat_ros.errors import DatasetError
from hat_ros.geometry import lie

_META = re.compile(r"(\d+)-meta\.mat")
_MESHES = ("textured.obj", "textured_simple.obj", "textured.ply", "points.ply")


@dataclass(frozen=True)
class _Meta:
    K: Float
    poses: dict[int, Float]  # class -> T_cam_target


def open_ycb_video(root: Path, model: Path | None = None, sequences: Collection[str] = ()) -> Iterator[ImageRecording]:
    """One recording per folder of frames and object.

    Args:
        root: the data set's folder, its ``data``, or one folder of frames.
        model: CAD model in metres of the object asked for; None = those in ``ROOT/models``, in order of their names.
        sequences: names ``FOLDER``, ``FOLDER_objCLASS`` or ``objCLASS`` to keep, empty = all.

    Raises:
        DatasetError: missing folders, malformed files, no CAD model, or one CAD model for several objects.
    """
    folders = [folder for folder in (root, *sorted(root.glob("*")), *sorted(root.glob("data/*"))) if _frames(folder)]
    if not folders:
        raise DatasetError(f"{root}: no frame like 000001-meta.mat, neither here nor in 'data/0048'")
    wanted: list[tuple[Path, str, int]] = []
    metas: dict[Path, dict[int, _Meta]] = {}
    for folder in folders:
        bare = folder == root
        frames = {number: _read_meta(path) for number, path in _frames(folder).items()}
        for object_id in sorted({object_id for meta in frames.values() for object_id in meta.poses}):
            name = f"obj{object_id}" if bare else f"{folder.name}_obj{object_id}"
            if not sequences or {name, folder.name, f"obj{object_id}"} & set(sequences):
                wanted.append((folder, name, object_id))
                metas[folder] = frames
    objects = sorted({object_id for _, _, object_id in wanted})
    if model is not None and len(objects) > 1:
        raise DatasetError(
            f"ycb_video: --model is one CAD model, and the frames show the objects {', '.join(map(str, objects))}: "
            f"name one with --sequence objCLASS"
        )
    for folder, name, object_id in wanted:
        mesh = model if model is not None else _mesh_of(root, object_id)
        yield _recording(folder, name, object_id, mesh, metas[folder])


def _frames(folder: Path) -> dict[int, Path]:
    if not folder.is_dir():
        return {}
    found = ((_META.fullmatch(path.name), path) for path in folder.iterdir())
    return {int(match[1]): path for match, path in sorted(found, key=lambda item: item[1]) if match}


def _read_meta(path: Path) -> _Meta:
    try:
        data: dict[str, Any] = scipy.io.loadmat(path)
    except Exception as error:  # the reader raises whatever the broken bytes lead it to
        raise DatasetError(f"{path}: not a MATLAB file that can be read ({type(error).__name__})") from None
    try:
        classes = np.asarray(data["cls_indexes"], dtype=np.float64).ravel()
        poses = np.asarray(data["poses"], dtype=np.float64)
        poses = poses.reshape(3, 4, -1)
        K = np.asarray(data["intrinsic_matrix"], dtype=np.float64).reshape(3, 3)
    except (KeyError, TypeError, ValueError):
        raise DatasetError(f"{path}: expected cls_indexes, poses (3, 4, n) and intrinsic_matrix (3, 3)") from None
    if poses.shape[2] != len(classes) or not np.isfinite(classes).all():
        raise DatasetError(f"{path}: {len(classes)} objects in cls_indexes, but {poses.shape[2]} poses")
    numbers = [int(value) for value in classes]
    if len(set(numbers)) < len(numbers):
        raise DatasetError(f"{path}: an object occurs twice; its instances cannot be told apart")
    out = {}
    for index, number in enumerate(numbers):
        T = lie.transform(poses[:, :3, index], poses[:, 3, index])
        if not lie.is_rigid(T, 1e-3):
            raise DatasetError(f"{path}: the pose of object {number} is not a rigid transform")
        out[number] = T
    return _Meta(K, out)


def _mesh_of(root: Path, object_id: int) -> Path:
    """The object's CAD model: classes count the folders of models in order of their names, from 1 on."""
    for models in (root / "models", root.parent / "models", root.parent.parent / "models"):
        folders = sorted(folder for folder in models.glob("[0-9][0-9][0-9]_*") if folder.is_dir())
        if len(folders) >= object_id:
            found = [folders[object_id - 1] / name for name in _MESHES]
            for path in found:
                if path.is_file():
                    return path
            raise DatasetError(f"{found[0].parent}: none of {', '.join(_MESHES)} in it")
    raise DatasetError(f"{root}: no folder 'models' with the CAD model of object {object_id}: name it with --model")


def _recording(folder: Path, name: str, object_id: int, mesh: Path, metas: dict[int, _Meta]) -> ImageRecording:
    files = []
    for number, path in _frames(folder).items():
        stem = path.name.removesuffix("-meta.mat")
        image = next((p for s in ("png", "jpg") if (p := folder / f"{stem}-color.{s}").is_file()), None)
        if image is None:
            raise DatasetError(f"{folder}: {stem}-meta.mat has no image {stem}-color.png or .jpg beside it")
        label = folder / f"{stem}-label.png"
        masks = (label,) if label.is_file() else ()
        files.append(ImageFile(stamp_of(number), image, metas[number].poses.get(object_id), masks))
    cameras = np.array([meta.K for meta in metas.values()])
    if not np.ptp(cameras, axis=0).max() < 1e-6:
        raise DatasetError(f"{folder}: intrinsic_matrix changes within the folder; split it at the change")
    camera = camera_from_label(cameras[0], image_size(files[0].image), f"{folder}, intrinsic_matrix")
    return ImageRecording(name, camera, mesh, files, mask_value=object_id)
