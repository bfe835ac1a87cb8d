"""SwissCube: BOP-like scenes of one object, ``testing/seq_000400/000000/{rgb,mask_visib,scene_*.json}``.

A flat layout without the inner ``000000`` occurs too. Translations and the CAD model are in millimetres.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from hat_ros.bench.datasets.bop import read_scene
from hat_ros.bench.datasets.image_files import ImageRecording
from hat_ros.bench.datasets.sequence import read_json
from hat_ros.errors import DatasetError


def open_swisscube(root: Path, model: Path | None = None, sequences: Collection[str] = ()) -> Iterator[ImageRecording]:
    """Recordings of the test split, one per sequence.

    Args:
        root: the data set's folder, or its ``testing`` folder.
        model: CAD model in millimetres; None = the only ``.ply`` in ``ROOT/models``.
        sequences: names such as ``seq_000400`` to keep, empty = all.

    Raises:
        DatasetError: missing folders, malformed files.
    """
    split = root / "testing" if (root / "testing").is_dir() else root
    folders = sorted(folder for folder in split.glob("seq_*") if folder.is_dir())
    if not folders:
        raise DatasetError(f"{split}: no folder 'seq_*'; give the folder that holds 'testing'")
    mesh = model if model is not None else _only_model(root)
    for folder in folders:
        if sequences and folder.name not in sequences:
            continue
        scene = folder / "000000" if (folder / "000000").is_dir() else folder
        gt, calibration = read_json(scene / "scene_gt.json"), read_json(scene / "scene_camera.json")
        yield read_scene(scene, folder.name, mesh, gt, calibration, None)


def _only_model(root: Path) -> Path:
    found = sorted((root / "models").glob("*.ply"))
    if len(found) != 1:
        raise DatasetError(f"{root / 'models'}: expected one .ply, found {len(found)}; name the CAD model with --model")
    return found[0]
