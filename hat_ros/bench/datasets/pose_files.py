"""Files of poses that another tracker made of a recording.

* TUM: ``stamp x y z qx qy qz qw`` per line, stamp in seconds of the recording's clock (what `poses.tum` holds).
* BOP: a ``.csv`` with ``scene_id,im_id,obj_id,score,R,t,time``, R 9 and t 3 numbers separated by blanks, t in
  millimetres; the best score of an image counts. An image's number is its frame number, and its ``time`` in seconds
  makes the frame rate, unless it is -1.
* A folder of ``NUMBER.txt`` with a 4 x 4 matrix each, metres, NUMBER the frame's (the ``ob_in_cam`` folder that
  FoundationPose leaves, from which RGBTrack derives).

Poses map target (the CAD file's own axes) to camera (OpenCV), as everywhere here.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.datasets.image_files import stamp_of
from hat_ros.errors import InputError
from hat_ros.geometry import lie

_BOP_COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")


@dataclass(frozen=True)
class ExternalPoses:
    """What a file of poses holds.

    Attributes:
        rows: stamp in nanoseconds -> pose row (7,) ``T_cam_target``.
        seconds: (N,) processing time of the images for which it is known.
    """

    rows: dict[int, Float]
    seconds: Float


def read_poses(path: Path, scene: tuple[int, int] | None = None) -> ExternalPoses:
    """Read a TUM or BOP file, or a folder of matrices.

    Args:
        path: ``.csv`` is BOP, a folder holds matrices, anything else is TUM.
        scene: (scene, object) whose rows of a BOP file count; None = the file has one only.

    Raises:
        InputError: missing, malformed, no pose in it, or several scenes or objects without ``scene``.
    """
    if path.is_dir():
        poses = _read_matrices(path)
    else:
        text = _read_text(path)
        poses = _read_bop(path, text, scene) if path.suffix == ".csv" else _read_tum(path, text)
    if not poses.rows:
        raise InputError(f"poses {path}: holds no pose" + (f" of scene, object {scene}" if scene else ""))
    return poses


def _read_text(path: Path) -> str:
    if path.exists() and not path.is_file():
        raise InputError(f"poses {path}: is not a file")
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"poses {path}: cannot be read ({getattr(error, 'strerror', None) or 'not text'})") from None


def _read_matrices(folder: Path) -> ExternalPoses:
    rows = {}
    for path in sorted(folder.glob("*.txt")):
        if not path.stem.isdigit():
            raise InputError(f"poses {path}: the name must be the frame's number, like 000012.txt")
        T = _numbers(_read_text(path).split(), f"poses {path}", 16).reshape(4, 4)
        if not lie.is_rigid(T, 1e-3):
            raise InputError(f"poses {path}: the matrix is no rigid transform")
        rows[stamp_of(int(path.stem))] = lie.row_from_matrix(T)
    return ExternalPoses(rows, np.zeros(0))


def _read_tum(path: Path, text: str) -> ExternalPoses:
    rows = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        where = f"poses {path}, line {number}"
        if len(words) != 8:
            raise InputError(f"{where}: expected stamp x y z qx qy qz qw, found {len(words)} columns")
        try:
            stamp_ns = int(Decimal(words[0]) * 1_000_000_000)
        except (InvalidOperation, ValueError, OverflowError):
            raise InputError(f"{where}: '{words[0]}' is no time in seconds") from None
        row = _numbers(words[1:], where)
        if abs(math.hypot(*row[3:]) - 1.0) > 0.01:
            raise InputError(f"{where}: the quaternion has length {math.hypot(*row[3:]):.4f}, expected 1")
        row[3:] /= np.linalg.norm(row[3:])
        rows[stamp_ns] = row
    return ExternalPoses(rows, np.zeros(0))


def _read_bop(path: Path, text: str, scene: tuple[int, int] | None) -> ExternalPoses:
    table = csv.DictReader(text.splitlines())
    if tuple(table.fieldnames or ()) != _BOP_COLUMNS:
        raise InputError(f"poses {path}: expected the columns {','.join(_BOP_COLUMNS)}, found {table.fieldnames}")
    best: dict[int, tuple[float, Float]] = {}
    seconds: dict[int, float] = {}
    seen: set[tuple[int, int]] = set()
    for number, line in enumerate(table, start=2):
        where = f"poses {path}, line {number}"
        try:
            of, image = (int(line["scene_id"]), int(line["obj_id"])), int(line["im_id"])
        except (TypeError, ValueError):
            raise InputError(f"{where}: scene_id, im_id and obj_id must be whole numbers") from None
        if scene is not None and of != scene:
            continue
        seen.add(of)
        score, time_s = _numbers([line["score"], line["time"]], where)
        R, t_mm = _numbers((line["R"] or "").split(), where, 9), _numbers((line["t"] or "").split(), where, 3)
        T = lie.transform(R.reshape(3, 3), 1e-3 * t_mm)
        if not lie.is_rigid(T, 1e-3):
            raise InputError(f"{where}: R is not a rotation matrix")
        if image not in best or score > best[image][0]:
            best[image] = (float(score), lie.row_from_matrix(T))
        if time_s >= 0:
            seconds[image] = float(time_s)
    if len(seen) > 1:
        raise InputError(f"poses {path}: holds {len(seen)} scenes or objects; give one file for each recording")
    return ExternalPoses({stamp_of(image): row for image, (_, row) in best.items()}, np.array(list(seconds.values())))


def _numbers(words: Sequence[str | None], where: str, count: int | None = None) -> Float:
    try:
        values = np.array([float(word or "nothing") for word in words])
    except ValueError:
        raise InputError(f"{where}: not numbers: {words}") from None
    if not np.isfinite(values).all() or (count is not None and len(values) != count):
        raise InputError(f"{where}: expected {count or len(words)} finite numbers, found {words}")
    return values
