"""The BOP layout (YCB-Video): scenes with ``rgb``, ``mask_visib``, ``scene_gt.json`` and ``scene_camera.json``.

    ROOT/models/models_info.json                 {"1": {"symmetries_discrete", "symmetries_continuous"}} mm, optional
    ROOT/test/000048/rgb/000001.png              ROOT/models/obj_000001.ply (millimetres)
    ROOT/test/000048/mask_visib/000001_000000.png   image, index of the entry in scene_gt
    ROOT/test/000048/scene_gt.json               {"1": [{"cam_R_m2c": [9], "cam_t_m2c": [3] mm, "obj_id"}]}
    ROOT/test/000048/scene_camera.json           {"1": {"cam_K": [9]}}

Each object of a scene is a recording of its own, and so is each instance (``..._inst0``) where one object occurs
several times. Image numbers become stamps, 0.1 s apart, gaps kept.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.datasets.image_files import ImageFile, ImageRecording, camera_from_label, image_size, stamp_of
from hat_ros.bench.datasets.instances import follow_instances
from hat_ros.bench.datasets.sequence import read_json
from hat_ros.errors import DatasetError
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry, symmetry_from_declaration

MILLIMETRE = 1e-3
TARGETS_FILE = "test_targets_bop19.json"
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
# Objects of YCB-Video that some rotation, or one of their texture, maps onto themselves: not scored by the paper.
_SYMMETRIC_YCBV = (1, 13, 16, 18, 19, 20, 21)


def open_bop(
    root: Path,
    model: Path | None = None,
    sequences: Collection[str] = (),
    targets_only: bool = False,
    without: Collection[int] = (),
) -> Iterator[ImageRecording]:
    """Recordings of a BOP data set's test split, one per scene and object.

    Args:
        root: the data set's folder.
        model: unused here: the models come with the data set.
        sequences: names ``SCENE``, ``SCENE_objID`` or ``SCENE_objID_instN`` to keep, empty = all.
        targets_only: keep ground truth only at the published targets (``test_targets_bop19.json``).
        without: object ids that are left out.

    Raises:
        DatasetError: missing folders, malformed files.
    """
    if model is not None:
        raise DatasetError("bop: the CAD models come with the data set (folder 'models'), do not give --model")
    split = root / "test"
    scenes = sorted(folder for folder in split.glob("*") if (folder / "scene_gt.json").is_file())
    if not scenes:
        raise DatasetError(
            f"{split}: no scene folder with scene_gt.json; give the folder that holds 'test' and 'models'"
        )
    listed = _targets(root / TARGETS_FILE) if targets_only else None
    symmetries = _symmetries(root / "models" / "models_info.json")
    for scene in scenes:
        gt, calibration = read_json(scene / "scene_gt.json"), read_json(scene / "scene_camera.json")
        for object_id in sorted(_objects(gt, scene) - set(without)):
            instances = _instances(gt, object_id, scene)
            whole = f"{scene.name}_obj{object_id}"
            names = [whole] if len(instances) == 1 else [f"{whole}_inst{index}" for index in range(len(instances))]
            if sequences and not {scene.name, whole, *names} & set(sequences):
                continue
            mesh = root / "models" / f"obj_{object_id:06d}.ply"
            if not mesh.is_file():
                raise DatasetError(f"{mesh}: CAD model of object {object_id} in scene {scene.name} is missing")
            ids = (int(scene.name), object_id) if scene.name.isdigit() else None
            for index, (name, entries) in enumerate(zip(names, instances, strict=True)):
                if not sequences or {scene.name, whole, name} & set(sequences):
                    recording = read_scene(scene, name, mesh, gt, calibration, object_id, listed, entries=entries)
                    instance = index if len(names) > 1 else None
                    yield replace(recording, scene=ids, instance=instance, symmetry=symmetries.get(object_id))


def _symmetries(path: Path) -> dict[int, Symmetry]:
    """Object -> the symmetry that ``models_info.json`` declares; objects without one are left out.

    Raises:
        DatasetError: malformed.
    """
    if not path.is_file():
        return {}
    found, models = {}, read_json(path)
    for key, info in models.items() if isinstance(models, dict) else ():
        keys = ("symmetries_discrete", "symmetries_continuous")
        if str(key).isdigit() and isinstance(info, dict) and set(keys) & set(info):
            try:
                discrete, continuous = (info.get(name, []) for name in keys)
                found[int(key)] = symmetry_from_declaration(discrete, continuous, MILLIMETRE)
            except ValueError as error:
                raise DatasetError(f"{path}, object {key}: {error}") from None
    return found


def open_ycbv(root: Path, model: Path | None = None, sequences: Collection[str] = ()) -> Iterator[ImageRecording]:
    """YCB-Video as the paper scores it: whole videos, ground truth at the BOP-19 targets of non-symmetric objects.

    Arguments and errors as of :func:`open_bop`; objects of a scene without any target are left out.
    """
    for recording in open_bop(root, model, sequences, targets_only=True, without=_SYMMETRIC_YCBV):
        if recording.truth():
            yield recording


def read_scene(
    scene: Path,
    name: str,
    mesh: Path,
    gt: Any,
    calibration: Any,
    object_id: int | None,
    targets: set[tuple[int, int, int]] | None = None,
    mesh_scale: float = MILLIMETRE,
    entries: Mapping[int, int] | None = None,
) -> ImageRecording:
    """One object of one scene; ``object_id`` None takes the first entry of every image.

    ``entries``: image number -> index of the entry that counts, for one of several instances.
    """
    files, cameras = [], []
    images = _images(scene)
    for number, image in sorted(images.items()):
        listed = gt.get(str(number), []) if isinstance(gt, dict) else []
        T_cam_target: Float | None = None
        masks: tuple[Path, ...] = ()
        for index, entry in enumerate(listed):
            is_asked = object_id is None or entry.get("obj_id") == object_id
            if is_asked if entries is None else entries.get(number) == index:
                T_cam_target = _pose(entry, f"{scene}/scene_gt.json, image {number}, entry {index}")
                mask = scene / "mask_visib" / f"{number:06d}_{index:06d}.png"
                masks = (mask,) if mask.is_file() else ()
                break
        if targets is not None and (int(scene.name), number, object_id) not in targets:
            T_cam_target = None
        files.append(ImageFile(stamp_of(number), image, T_cam_target, masks))
        cameras.append(_K(calibration, number, scene))
    if not np.ptp(cameras, axis=0).max() < 1e-6:
        raise DatasetError(f"{scene}/scene_camera.json: cam_K changes within the scene; split it at the change")
    camera = camera_from_label(cameras[0], image_size(files[0].image), f"{scene}/scene_camera.json")
    return ImageRecording(name, camera, mesh, files, unit_scale=mesh_scale)


def _images(scene: Path) -> dict[int, Path]:
    folder = scene / "rgb"
    images = {int(p.stem): p for p in folder.glob("*") if p.suffix.lower() in _IMAGE_SUFFIXES and p.stem.isdigit()}
    if not images:
        raise DatasetError(f"{folder}: no images named by number (000000.png or .jpg)")
    return images


def _objects(gt: Any, scene: Path) -> set[int]:
    found: dict[int, int] = defaultdict(int)
    try:
        for entries in gt.values():
            for entry in entries:
                found[int(entry["obj_id"])] += 1
    except (AttributeError, KeyError, TypeError, ValueError):
        raise DatasetError(f"{scene}/scene_gt.json: expected image number -> list of entries with obj_id") from None
    return set(found)


def _instances(gt: Any, object_id: int, scene: Path) -> list[dict[int, int]]:
    """Per instance of an object: image number -> index of its entry."""
    places: dict[int, dict[int, Float]] = {}
    for number, entries in gt.items():
        for index, entry in enumerate(entries):
            if int(entry["obj_id"]) == object_id:
                T = _pose(entry, f"{scene}/scene_gt.json, image {number}, entry {index}")
                places.setdefault(_number(number, scene), {})[index] = T[:3, 3]
    if all(len(found) == 1 for found in places.values()):
        return [{number: next(iter(found)) for number, found in places.items()}]
    return follow_instances(places, f"{scene}/scene_gt.json")


def _number(text: str, scene: Path) -> int:
    if not text.isdigit():
        raise DatasetError(f"{scene}/scene_gt.json: images are called by their number, found '{text}'")
    return int(text)


def _pose(entry: Any, where: str) -> Float:
    try:
        R = np.array(entry["cam_R_m2c"], dtype=np.float64).reshape(3, 3)
        t = np.array(entry["cam_t_m2c"], dtype=np.float64).reshape(3) * MILLIMETRE
    except (KeyError, TypeError, ValueError):
        raise DatasetError(f"{where}: expected cam_R_m2c (9 numbers) and cam_t_m2c (3 numbers)") from None
    T = lie.transform(R, t)
    if not lie.is_rigid(T, 1e-3):
        raise DatasetError(f"{where}: cam_R_m2c is not a rotation matrix or the pose is not finite")
    return T


def _K(calibration: Any, number: int, scene: Path) -> Float:
    try:
        return np.array(calibration[str(number)]["cam_K"], dtype=np.float64).reshape(9)
    except (KeyError, TypeError, ValueError):
        raise DatasetError(f"{scene}/scene_camera.json: image {number} has no cam_K of 9 numbers") from None


def _targets(path: Path) -> set[tuple[int, int, int]]:
    try:
        return {(int(item["scene_id"]), int(item["im_id"]), int(item["obj_id"])) for item in read_json(path)}
    except (KeyError, TypeError, ValueError):
        raise DatasetError(f"{path}: expected a list of scene_id, im_id, obj_id") from None
