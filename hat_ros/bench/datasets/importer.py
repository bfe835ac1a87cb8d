"""``hat import``: recordings of any known data set into bags, one per sequence, resumable; and a look at the labels."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hat_ros.array_types import Float, UInt8
from hat_ros.bench.datasets.detections import load_detections
from hat_ros.bench.datasets.image_files import ImageFile, ImageRecording
from hat_ros.errors import DatasetError, UsageError
from hat_ros.geometry.symmetry import declaration_of
from hat_ros.io import own_folder
from hat_ros.io.bag_writer import BagWriter
from hat_ros.io.provenance import input_hash
from hat_ros.target.mesh_file import companions_of
from hat_ros.target.rendering import create_renderer
from hat_ros.types import Camera, Frame

LOG = logging.getLogger(__name__)

# In a bag: what the import made it from.
IMPORT_FILE = "import.json"
# name -> opener(root, model, sequences)
FORMATS = {
    "sequence": "hat_ros.bench.datasets.sequence:open_sequences",
    "spark": "hat_ros.bench.datasets.spark:open_spark",
    "shirt": "hat_ros.bench.datasets.shirt:open_shirt",
    "swisscube": "hat_ros.bench.datasets.swisscube:open_swisscube",
    "bop": "hat_ros.bench.datasets.bop:open_bop",
    "ycbv": "hat_ros.bench.datasets.bop:open_ycbv",
    "ycb_video": "hat_ros.bench.datasets.ycb_video:open_ycb_video",
    "speed": "hat_ros.bench.datasets.speed:open_speed",
}

Progress = Callable[[str, int, int], None]


def open_dataset(
    fmt: str, root: str | Path, model: str | Path | None = None, sequences: Collection[str] = ()
) -> Iterator[ImageRecording]:
    """Recordings of a data set in its own layout, without writing anything.

    Args:
        fmt: one of :data:`FORMATS`.
        root: the data set's folder.
        model: CAD model, for data sets that bring none.
        sequences: names to keep, empty = all.

    Raises:
        UsageError: unknown format.
        DatasetError: the folder does not have the layout, or a named sequence does not exist.
    """
    if fmt not in FORMATS:
        raise UsageError(f"format '{fmt}' is not known, choose one of {', '.join(FORMATS)}")
    root, model = Path(root), None if model is None else Path(model)
    if not root.is_dir():
        raise DatasetError(f"{root}: no such folder")
    if model is not None and not model.is_file():
        raise DatasetError(f"CAD model {model}: no such file")
    module_name, function_name = FORMATS[fmt].split(":")
    found = False
    for recording in getattr(import_module(module_name), function_name)(root, model, sequences):
        found = True
        yield recording
    if not found:
        named = f"named {', '.join(sequences)}" if sequences else "that could be scored"
        raise DatasetError(f"{root}: no sequence {named}")


def import_dataset(
    fmt: str,
    root: str | Path,
    out: str | Path,
    *,
    model: str | Path | None = None,
    sequences: Collection[str] = (),
    boxes: bool = False,
    detections: str | Path | None = None,
    instance: int | None = None,
    check: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Write bags: ``out`` itself for the ``sequence`` format, ``out/NAME`` per sequence otherwise.

    Bags that are complete already are left alone, so an interrupted import goes on where it stopped. What a bag was
    made from stands in its ``import.json``; one made with another CAD model, or with other masks or boxes, is written
    again.

    Args:
        fmt: see :func:`open_dataset`, as are ``root``, ``model`` and ``sequences``.
        out: where to.
        boxes: give frames without a mask the box of the CAD at the true pose, see :func:`with_annotation_boxes`.
        detections: masks or boxes computed elsewhere instead of the data set's own, see :func:`with_detections`; a
            folder with ``NAME`` or ``NAME.json`` for each sequence, or what there is of the only one.
        instance: of several instances of one object only the one of this number; objects that occur once are kept.
        check: also write ``NAME.check.png`` beside each bag, see :func:`check_picture`.
        progress: called with (sequence, frames done, frames in all).

    Returns:
        The bags, complete.

    Raises:
        UsageError, DatasetError, MeshError: see :func:`open_dataset` and ``load_target``. Also for a folder that is no
            bag, or a bag that no import has made and that lacks the boxes or detections asked for.
        RunError: the bag cannot be written.
    """
    if boxes and detections is not None:
        raise UsageError("boxes from the labels and detections from elsewhere exclude each other, choose one")
    out, bags = own_folder.checked_out(out), []
    recordings: Iterable[ImageRecording] = open_dataset(fmt, root, model, sequences)
    found: dict[str, Path] = {}
    if instance is not None:
        recordings = _with_instance(recordings, instance)
    if detections is not None:  # which of them belong to a sequence depends on how many there are
        recordings = every = list(recordings)
        found = detections_by_sequence(Path(detections), every)
    for recording in recordings:
        bag = out if fmt == "sequence" else out / recording.name
        regions = found.get(recording.name)
        made_from = _made_from(fmt, recording, boxes, regions)
        if not _complete(bag, made_from):
            if regions is not None:
                recording = with_detections(recording, regions)
            recording = with_annotation_boxes(recording) if boxes else recording
            _write_bag(recording, bag, made_from, progress)
        elif progress is not None:
            progress(recording.name, len(recording), len(recording))
        if check:
            picture = check_picture(recording)
            cv2.imwrite(str(bag.with_name(f"{bag.name}.check.png")), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        bags.append(bag)
    return bags


def _with_instance(recordings: Iterable[ImageRecording], number: int) -> list[ImageRecording]:
    """Those of this instance, and objects that occur once.

    Raises:
        DatasetError: no object has an instance of this number.
    """
    every = list(recordings)
    if not any(recording.instance == number for recording in every):
        numbers = sorted({recording.instance for recording in every if recording.instance is not None})
        found = f"instances have the numbers {numbers[0]} to {numbers[-1]}" if numbers else "no object occurs twice"
        raise DatasetError(f"no instance {number}: in what is imported {found}")
    return [recording for recording in every if recording.instance in (None, number)]


def _made_from(fmt: str, recording: ImageRecording, boxes: bool, detections: Path | None) -> dict[str, Any]:
    """What decides a bag's content beside the data set's own images and labels."""
    model = recording.model_file()
    companions = companions_of(model.mesh)
    return {
        "format": fmt,
        "sequence": recording.name,
        "model_sha256": input_hash(model.mesh),
        **({"companions_sha256": {name: input_hash(path) for name, path in companions.items()}} if companions else {}),
        **({"symmetry": declaration_of(model.symmetry)} if model.symmetry is not None else {}),
        # Where a target.yaml states a scale of its own.
        **({"unit_scale": model.unit_scale} if model.unit_scale != recording.unit_scale else {}),
        **({} if np.array_equal(model.T_label_cad, np.eye(4)) else {"T_label_cad": model.T_label_cad.tolist()}),
        "boxes_from_labels": boxes,
        "detections": None if detections is None else detections.name,
        "detections_sha256": None if detections is None else input_hash(detections),
    }


def _complete(bag: Path, made_from: dict[str, Any]) -> bool:
    """Whether there is a bag made from just this."""
    if not (bag / "metadata.yaml").is_file():
        if bag.exists():
            raise UsageError(f"{bag} exists and is not a bag; choose another --out or remove it")
        return False
    try:
        before = json.loads((bag / IMPORT_FILE).read_text(encoding="utf-8"))
    except FileNotFoundError:
        if made_from["boxes_from_labels"] or made_from["detections"]:
            raise UsageError(
                f"{bag} is a bag that no import has made, its masks are not replaced: choose another --out or remove it"
            ) from None
        return True
    except (OSError, ValueError):
        before = {}
    changed = [key for key, value in made_from.items() if before.get(key) != value]
    if changed:
        LOG.warning("%s was made with other %s: writing it again", bag, ", ".join(changed))
    return not changed


def _write_bag(recording: ImageRecording, bag: Path, made_from: dict[str, Any], progress: Progress | None) -> None:
    """Write beside the goal and rename, so that a bag under its own name is always complete."""
    recording.load_target()  # a bad CAD model is found before the long part
    partial = bag.with_name(f"{bag.name}.partial")
    with own_folder.NewFolder(partial):
        _fill(recording, partial / bag.name, made_from, progress)
        own_folder.remove(bag)  # made from something else
        (partial / bag.name).rename(bag)
    own_folder.remove(partial)


def _fill(recording: ImageRecording, bag: Path, made_from: dict[str, Any], progress: Progress | None) -> None:
    """Write the whole bag."""
    with BagWriter(bag, image_format="png") as writer:
        # Decoding also proves that every file can be read and has the right size.
        for index, (item, frame) in enumerate(zip(recording.files, recording.frames(masks=False), strict=True)):
            writer.write_frame(
                item.stamp_ns,
                _image(recording, item, frame),
                recording.camera,
                mask=recording.given_mask(item),
                T_cam_target=item.T_cam_target,
            )
            if progress is not None:
                progress(recording.name, index + 1, len(recording))
        model = recording.model_file()
        writer.write_target(model.mesh, model.unit_scale, recording.name, model.symmetry, model.T_label_cad)
        text = json.dumps(made_from, indent=2) + "\n"
        (bag / IMPORT_FILE).write_text(text, encoding="utf-8")
    own_folder.mark(bag)


def _image(recording: ImageRecording, item: ImageFile, frame: Frame) -> bytes | UInt8:
    """The file's own bytes where nothing has to change, else undistorted pixels (stored without loss)."""
    if recording.distortion.any() or item.image.suffix.lower() not in (".jpg", ".jpeg", ".png"):
        return frame.rgb
    return item.image.read_bytes()


def with_annotation_boxes(recording: ImageRecording, corners: bool = False) -> ImageRecording:
    """Boxes from the labels for frames without a mask: the paper's regions for SHIRT, which has no detector of its own.

    They land in ``/detection/mask`` as filled boxes (128) and are used by ``segmentation.backend=annotated`` alone.

    Args:
        recording: with labels.
        corners: project the eight corners of the CAD model's bounding box (as published), not its vertices.
    """
    vertices = recording.load_target().vertices_m
    if corners:
        sides = np.stack([vertices.min(axis=0), vertices.max(axis=0)], axis=1)
        vertices = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 3)
    files = []
    for item in recording.files:
        T = item.T_cam_target
        if T is not None and not item.masks:
            points = vertices @ T[:3, :3].T + T[:3, 3]
            if points[:, 2].min() > 0:
                uv = recording.camera.project(points)
                item = replace(item, box_xyxy=np.concatenate([uv.min(axis=0), uv.max(axis=0)]))
        files.append(item)
    return replace(recording, files=files)


def detections_by_sequence(path: Path, recordings: Sequence[ImageRecording]) -> dict[str, Path]:
    """Sequence name -> its detections: ``path/NAME``, ``path/NAME.json``, or ``path`` itself.

    ``path`` itself can only serve one sequence, or those of a BOP data set, where each detection names its scene.

    Raises:
        UsageError: there are several sequences, and one has no detections of its own.
    """
    found = {}
    for recording in recordings:
        own = (path / recording.name, path / f"{recording.name}.json")
        found[recording.name] = next((item for item in own if item.exists()), path)
        if found[recording.name] == path and len(recordings) > 1 and (recording.scene is None or path.is_dir()):
            raise UsageError(
                f"detections {path}: {len(recordings)} sequences are asked for, and there is neither {own[0].name} nor "
                f"{own[1].name} in it; put one file or folder per sequence there, or name one --sequence"
            )
    return found


def with_detections(recording: ImageRecording, path: Path) -> ImageRecording:
    """Detections computed elsewhere in place of the data set's own masks and boxes.

    Frames that have none there have none at all. They are read by ``segmentation.detections.load_detections``, land in
    ``/detection/mask`` and are used by ``segmentation.backend=annotated`` alone.

    Raises:
        DatasetError: malformed, or not of this recording: no image of that name or number.
    """
    lookup = load_detections(path, recording.scene)
    if not any(item.image.name in lookup for item in recording.files):
        raise DatasetError(
            f"{path}: none of its {len(lookup)} detections names an image of {recording.name}, which are called like "
            f"{recording.files[0].image.name}"
        )
    return replace(recording, detections=lookup)


def check_picture(recording: ImageRecording, width_px: int = 640) -> UInt8:
    """First, middle and last labelled frame over the CAD rendered at the true pose, outlined in green: (H, W, 3) RGB.

    Wrong units, quaternion order, frames or axes show at once: the outline misses the target. A mirrored or turned
    model shows in the row below, which must look like the row above but for the light. The axes of the labels are drawn
    at the true pose (x red, y green, z blue, as long as the target's radius), and where ``T_label_cad`` says that the
    CAD file has others, these too, thinner and dimmed.

    Raises:
        DatasetError: the recording has no ground truth.
    """
    labelled = [(item, T) for item in recording.files if (T := item.T_cam_target) is not None]
    if not labelled:
        raise DatasetError(f"{recording.name}: no frame has a ground truth, nothing to check")
    target = recording.load_target()
    T_label_cad = recording.model_file().T_label_cad
    renderer = create_renderer("rays", target)
    columns = []
    for item, T_cam_target in (labelled[0], labelled[len(labelled) // 2], labelled[-1]):
        rgb = next(replace(recording, files=[item]).frames(masks=False)).rgb.copy()
        view = renderer.render(T_cam_target, recording.camera)
        contours, _ = cv2.findContours(view.mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        thickness = max(1, rgb.shape[1] // 640)
        cv2.drawContours(rgb, contours, -1, (0, 255, 0), thickness)
        if not np.array_equal(T_label_cad, np.eye(4)):
            _draw_axes(rgb, recording.camera, T_cam_target @ T_label_cad, target.bounding_radius_m, 140, thickness)
        _draw_axes(rgb, recording.camera, T_cam_target, target.bounding_radius_m, 255, 2 * thickness)
        height_px = round(rgb.shape[0] * width_px / rgb.shape[1])
        both = np.concatenate([rgb, view.rgb])
        columns.append(cv2.resize(both, (width_px, 2 * height_px), interpolation=cv2.INTER_AREA))
    return np.concatenate(columns, axis=1)


def _draw_axes(
    rgb: UInt8, camera: Camera, T_cam_frame: Float, length_m: float, brightness: int, thickness: int
) -> None:
    """Draw the axes of a frame (4, 4) into an image (H, W, 3): x red, y green, z blue; not those behind the camera."""
    ends = T_cam_frame[:3, 3] + length_m * np.vstack([np.zeros(3), T_cam_frame[:3, :3].T])
    if ends[:, 2].min() <= 0:
        return
    origin, *tips = np.rint(np.clip(camera.project(ends), -1e4, 1e4)).astype(int).tolist()
    for axis, tip in enumerate(tips):
        color = [0, 0, 0]
        color[axis] = brightness
        cv2.line(rgb, origin, tip, color, thickness, cv2.LINE_AA)
