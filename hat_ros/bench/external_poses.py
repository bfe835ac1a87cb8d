"""Poses of a method that is not part of this package, scored beside those that are.

Trackers under other licences (RGBTrack, FoundationPose, a lab's own) are run by those who have them; what they bring is
a file of poses, and from then on they are a run like any other: a result folder, a row in the benchmark's table.

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
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import islice
from pathlib import Path

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.datasets.image_files import stamp_of
from hat_ros.bench.evaluation.folder import complete_folder
from hat_ros.bench.source import Source, SourceSpec
from hat_ros.config import HatConfig
from hat_ros.errors import InputError, UsageError
from hat_ros.geometry import lie
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.provenance import describe_run, input_hash
from hat_ros.io.result_bag import ResultBagWriter
from hat_ros.io.results import CONFIG_FILE, RUN_FILE, ResultFolder, write_json
from hat_ros.tracker import Step
from hat_ros.types import Candidates, Estimate, Motion, Selection, TrackState

# Stamps that went through another program's floating point.
_STAMP_TOLERANCE_NS = 1_000_000
_BOP_COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
_NO_POSE = np.full(7, np.nan)
_NO_COVARIANCE = np.full((6, 6), np.nan)


@dataclass(frozen=True)
class ExternalPoses:
    """What a file of poses holds.

    Attributes:
        rows: stamp in nanoseconds -> pose row (7,) ``T_cam_target``.
        seconds: (N,) processing time of the images for which it is known.
    """

    rows: dict[int, Float]
    seconds: Float


@dataclass(frozen=True)
class ScoreOptions:
    """How to score.

    Attributes:
        method: what the table calls it.
        fps: frames per second as measured by who ran it; None = from the file, if it says.
        start, limit, video, report, overwrite: as for a run of our own.
    """

    method: str
    fps: float | None = None
    start: int = 0
    limit: int | None = None
    video: bool = True
    report: bool = True
    overwrite: bool = False


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


def score_poses(spec: SourceSpec, poses: Path, out: Path, options: ScoreOptions) -> Path:
    """Write the result folder of an external method's poses on a recording.

    Raises:
        InputError: the recording or the file of poses is bad, or they share no frame.
        UsageError: ``out`` exists and must not be replaced.
    """
    folder = ResultFolder(out, options.overwrite)
    source = spec.open()
    stamps = frame_stamps(source, options.start, options.limit)
    found = read_poses(poses, getattr(source.recording, "scene", None))
    rows = match_stamps(stamps, found.rows)
    if not rows:
        raise InputError(f"poses {poses}: none lies within 1 ms of a frame of {spec.path}; stamps begin at {stamps[0]}")
    with folder:
        (folder.path / CONFIG_FILE).write_text(f"# {options.method}: poses of an external method\n", encoding="utf-8")
        run = describe_run(
            spec.path,
            spec.sha256(),
            HatConfig(),
            **spec.describe(),
            mode=options.method,
            poses=str(poses.resolve()),
            poses_sha256=input_hash(poses),
            poses_unmatched=len(found.rows) - len(rows),
            start=options.start,
            limit=options.limit,
        )
        write_json(folder.path / RUN_FILE, run | {"config_sha256": None})
        _write_bag(folder.bag_path, source, stamps, rows)
        fps = options.fps if options.fps is not None else _rate(found.seconds)
        measured = {"fps": fps, "latency_ms_p50": float("nan"), "latency_ms_p99": float("nan")}
        complete_folder(folder.path, source, measured, video=options.video, report=options.report)
    return folder.final_path


def frame_stamps(source: Source, start: int = 0, limit: int | None = None) -> list[int]:
    """Stamps of the recording's frames in order, without decoding them.

    Raises:
        UsageError: ``start`` leaves no frame.
    """
    recording = source.recording
    if isinstance(recording, BagReader):
        every = (packet.stamp_ns for packet in recording.packets())
    else:
        every = (item.stamp_ns for item in recording.files)
    stamps = list(islice(every, start, None if limit is None else start + limit))
    if not stamps:
        raise UsageError(f"{source.path} has {source.count()} frames, --start {start} leaves none")
    return stamps


def match_stamps(stamps: list[int], rows: dict[int, Float]) -> dict[int, Float]:
    """Frame stamp -> pose row of the pose stamped within 1 ms of it; the nearest, where there are several."""
    given = np.array(sorted(rows), dtype=np.int64)
    matched = {}
    for stamp in stamps:
        after = int(np.searchsorted(given, stamp))
        near = given[max(after - 1, 0) : after + 1]
        nearest = int(near[np.argmin(np.abs(near - stamp))]) if len(near) else None
        if nearest is not None and abs(nearest - stamp) <= _STAMP_TOLERANCE_NS:
            matched[stamp] = rows[nearest]
    return matched


def _write_bag(path: Path, source: Source, stamps: list[int], rows: dict[int, Float]) -> None:
    with ResultBagWriter(path, source.frame_id, source.target.name) as bag:
        for stamp in stamps:
            state = TrackState.TRACKING if stamp in rows else TrackState.LOST
            estimate = Estimate(stamp, state, rows.get(stamp, _NO_POSE), _NO_COVARIANCE)
            bag.write_step(Step(None, Candidates.none(), Motion.none(), Selection.none(), estimate), 0)
        bag.write_context(source.recording.camera, source.truth_rows())


def _rate(seconds: Float) -> float:
    return float(1.0 / seconds.mean()) if len(seconds) and seconds.mean() > 0 else float("nan")


def _read_text(path: Path) -> str:
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
        if abs(np.linalg.norm(row[3:]) - 1.0) > 0.01:
            raise InputError(f"{where}: the quaternion has length {np.linalg.norm(row[3:]):.4f}, expected 1")
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


def _numbers(words: list[str | None], where: str, count: int | None = None) -> Float:
    try:
        values = np.array([float(word or "nothing") for word in words])
    except ValueError:
        raise InputError(f"{where}: not numbers: {words}") from None
    if not np.isfinite(values).all() or (count is not None and len(values) != count):
        raise InputError(f"{where}: expected {count or len(words)} finite numbers, found {words}")
    return values
