"""Sequences of a data set used where they lie: a folder with a small ``dataset.yaml`` instead of a bag.

Whatever takes a recording takes such a folder, so that a benchmark over a whole data set copies no image.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from pathlib import Path

import yaml

from hat_ros.datasets.image_files import ImageRecording
from hat_ros.datasets.importer import open_dataset, with_annotation_boxes
from hat_ros.errors import DatasetError, UsageError
from hat_ros.target import load_target

LINK_FILE = "dataset.yaml"
_KEYS = {"format", "root", "sequence", "model", "boxes", "listing_sha256"}


def write_links(
    fmt: str,
    root: str | Path,
    out: str | Path,
    *,
    model: str | Path | None = None,
    sequences: Collection[str] = (),
    boxes: bool = False,
) -> list[Path]:
    """One folder ``out/NAME`` with a ``dataset.yaml`` per sequence; see ``import_dataset`` for the arguments.

    Raises:
        UsageError, DatasetError, MeshError: as ``import_dataset``.
    """
    folders = []
    for recording in open_dataset(fmt, root, model, sequences):
        load_target(recording.target_path, recording.unit_scale)
        folder = Path(out) / recording.name
        if folder.exists() and not (folder / LINK_FILE).is_file():
            raise UsageError(f"{folder} exists and is not a link to a data set; choose another --out or remove it")
        folder.mkdir(parents=True, exist_ok=True)
        content = {
            "format": fmt,
            "root": str(Path(root).resolve()),
            "sequence": recording.name,
            "model": None if model is None else str(Path(model).resolve()),
            "boxes": boxes,
            "listing_sha256": listing_sha256(recording),
        }
        (folder / LINK_FILE).write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
        folders.append(folder)
    return folders


def open_link(folder: str | Path) -> ImageRecording:
    """The sequence that a folder's ``dataset.yaml`` names.

    Raises:
        DatasetError: malformed link, or the data set is gone or no longer what it was.
    """
    path = Path(folder) / LINK_FILE
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DatasetError(f"{path}: cannot be read ({' '.join(str(error).split())})") from None
    if not isinstance(content, dict) or set(content) != _KEYS:
        raise DatasetError(
            f"{path}: expected exactly the keys {', '.join(sorted(_KEYS))}; run `hat import --link` again"
        )
    sequence = str(content["sequence"])
    (recording,) = open_dataset(str(content["format"]), str(content["root"]), content["model"], [sequence])
    if listing_sha256(recording) != content["listing_sha256"]:
        raise DatasetError(f"{path}: files or labels of '{sequence}' changed since the link was made; make it again")
    return with_annotation_boxes(recording) if content["boxes"] else recording


def listing_sha256(recording: ImageRecording) -> str:
    """Digest of what a recording consists of: calibration, model, names and sizes of the files, labels."""
    digest = hashlib.sha256(recording.camera.K.tobytes() + recording.distortion.tobytes())
    digest.update(repr((recording.unit_scale, recording.target_path.name)).encode())
    digest.update(recording.target_path.read_bytes())
    for item in recording.files:
        names = [(path.name, path.stat().st_size) for path in (item.image, *item.masks)]
        digest.update(repr((item.stamp_ns, names)).encode())
        digest.update(b"" if item.T_cam_target is None else item.T_cam_target.tobytes())
    return digest.hexdigest()
