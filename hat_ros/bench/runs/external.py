"""``hat score``: poses of a method that is not part of this package, scored beside those that are.

Trackers under other licences (RGBTrack, FoundationPose, a lab's own) are run by those who have them; what they bring is
a file of poses (:mod:`hat_ros.bench.datasets.pose_files`), and from then on they are a run like any other: a result
folder, a row in the benchmark's table.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.datasets.image_files import ImageRecording
from hat_ros.bench.datasets.pose_files import read_poses
from hat_ros.bench.evaluation.result_folder import complete_folder
from hat_ros.bench.runs.folder import RunOptions, record_frames, result_folder
from hat_ros.bench.source import Source, SourceSpec
from hat_ros.config import CameraConfig
from hat_ros.core.refusals import Refusals
from hat_ros.errors import InputError, UsageError
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.provenance import input_hash
from hat_ros.io.result_bag import ResultBagWriter
from hat_ros.io.results import ResultFolder
from hat_ros.tracker import Step
from hat_ros.types import Candidates, Estimate, Motion, Selection, TrackState

# Stamps that went through another program's floating point.
_STAMP_TOLERANCE_NS = 1_000_000
_NO_POSE = np.full(7, np.nan)
_NO_COVARIANCE = np.full((6, 6), np.nan)


@dataclass(frozen=True, kw_only=True)
class ScoreOptions(RunOptions):
    """How to score.

    Attributes:
        method: what the table calls it.
        fps: frames per second as measured by who ran it; None = from the file, if it says.
        camera: what the messages of a bag do not say of the camera.
    """

    method: str
    fps: float | None = None
    camera: CameraConfig = field(default_factory=CameraConfig)


def score_poses(spec: SourceSpec, poses: Path, out: Path, options: ScoreOptions) -> Path:
    """Write the result folder of an external method's poses on a recording.

    Raises:
        InputError: the recording or the file of poses is bad, or they share no frame.
        UsageError: ``out`` exists and must not be replaced.
    """
    folder = ResultFolder(out, options.overwrite)
    source = spec.open(options.camera)
    stamps = frame_stamps(source, options.start, options.limit)
    scene = source.recording.scene if isinstance(source.recording, ImageRecording) else None
    found = read_poses(poses, scene)
    rows = match_stamps(stamps, found.rows)
    if not rows:
        raise InputError(f"poses {poses}: none lies within 1 ms of a frame of {spec.path}; stamps begin at {stamps[0]}")
    how = {
        "poses": str(poses.resolve()),
        "poses_sha256": input_hash(poses),
        "poses_unmatched": len(found.rows) - len(rows),
        "start": options.start,
        "limit": options.limit,
    }
    with result_folder(folder, spec, None, mode=options.method, **how):
        _write_bag(folder.bag_path, source, stamps, rows)
        record_frames(folder.path, len(stamps), Refusals())
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
