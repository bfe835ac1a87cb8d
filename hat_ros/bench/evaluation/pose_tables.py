"""``poses.tum`` and ``poses.csv``: every pose of a finished run, and its errors."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hat_ros.bench.evaluation.metrics import pose_errors
from hat_ros.io.results import tum_line
from hat_ros.io.run_log import RunLog
from hat_ros.types import TrackState

POSE_COLUMNS = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
CSV_COLUMNS = (
    "stamp_ns",
    "state",
    *POSE_COLUMNS,
    "keyframe",
    "n_candidates",
    "anchor",
    "gap_frames",
    "E_t_m",
    "E_q_deg",
    "E_p",
)


def write_tables(path: Path, log: RunLog) -> None:
    """``poses.tum`` and ``poses.csv`` of a finished run."""
    errors = pose_errors(log.T_est, log.T_true)
    with (path / "poses.tum").open("w", encoding="utf-8", newline="") as tum:
        for i in np.flatnonzero(log.has_output):
            tum.write(tum_line(int(log.stamp_ns[i]), log.pose_rows[i]))
    with (path / "poses.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(CSV_COLUMNS)
        for i in range(len(log)):
            pose = log.pose_rows[i] if log.has_output[i] else np.full(7, np.nan)
            table.writerow(
                (
                    int(log.stamp_ns[i]),
                    TrackState(int(log.state[i])).name,
                    *_cells(pose),
                    int(log.keyframe[i]),
                    len(log.candidates[i]),
                    int(log.anchor[i]),
                    int(log.gap_frames[i]),
                    *_cells((errors.translation_m[i], np.degrees(errors.rotation_rad[i]), errors.pose[i])),
                )
            )


def _cells(values: Iterable[float]) -> list[str]:
    """Numbers in full precision, an empty cell for NaN."""
    return ["" if np.isnan(value) else repr(float(value)) for value in values]
