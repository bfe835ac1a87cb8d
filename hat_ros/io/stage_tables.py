"""The stages' answers and the record of admission as tables, and back."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.errors import WireError
from hat_ros.io import topics
from hat_ros.io.message_family import stamp_of
from hat_ros.io.table import TableWire, check_poses, flag, one_row, read_table, whole_number
from hat_ros.types import Alignment, Candidates, Estimate, Motion, Selection, StateReason, TrackState

# The elements of a covariance (6, 6) that are sent.
_UPPER = np.triu_indices(6)


@dataclass(frozen=True)
class Admitted:
    """The record of entry of one frame, ``/hat/admission``: it gives every stage the order of the frames.

    Attributes:
        seq: number of the frame since the start of the run, from 0.
        dropped_total: frames not admitted so far (live drops, rejected stamps or images).
        epoch: counts resets of the graph; a new one tells every stage to start afresh at this frame.
        resumed: 1 if this epoch goes on with a target that was confirmed in the one before: a stage was lost, not the
            target.
        initial_pose: 1 if an initial pose comes into force here; ``/hat/initial_pose`` has it, with the same stamp.
    """

    seq: int
    dropped_total: int
    epoch: int
    resumed: int = 0
    initial_pose: int = 0


@dataclass(frozen=True)
class Status:
    """One row of ``/hat/status``: the estimate (without alignment) and its place in the run."""

    estimate: Estimate
    seq: int
    dropped_total: int
    alignment_version: int


class StageWire(TableWire):
    """Encodes the answers of the stages to a frame."""

    def admission(self, stamp_ns: int, frame_id: str, admitted: Admitted) -> Any:
        """Table of ``/hat/admission``."""
        row = np.array([astuple(admitted)], dtype=np.float64)
        return self.table(stamp_ns, frame_id, topics.ADMISSION_COLUMNS, row)

    def candidates(self, stamp_ns: int, frame_id: str, candidates: Candidates) -> Any:
        """Table of ``/hat/hypotheses_scored``."""
        return self.table(stamp_ns, frame_id, topics.CANDIDATE_COLUMNS, _candidate_rows(candidates))

    def selection(self, stamp_ns: int, frame_id: str, selection: Selection) -> Any:
        """Table of ``/hat/selection``."""
        selected = (np.arange(len(selection.candidates)) == selection.selected).astype(np.float64)
        rows = np.column_stack(
            [_candidate_rows(selection.candidates), selection.scaled_score, selection.path_score, selected]
        )
        return self.table(stamp_ns, frame_id, topics.SELECTION_COLUMNS, rows)

    def motion(self, stamp_ns: int, frame_id: str, motion: Motion) -> Any:
        """Table of ``/hat/slam_state``."""
        row = np.concatenate([[motion.valid, motion.epoch], motion.pose_row, [motion.n_keyframes]])
        return self.table(stamp_ns, frame_id, topics.MOTION_COLUMNS, row)

    def alignment(self, stamp_ns: int, frame_id: str, alignment: Alignment) -> Any:
        """Table of ``/hat/alignment``."""
        a = alignment
        row = np.concatenate([[a.version, a.scale], a.quat_xyzw, a.translation_m, [a.n_anchors, a.rms, a.epoch]])
        return self.table(stamp_ns, frame_id, topics.ALIGNMENT_COLUMNS, row)

    def status(self, frame_id: str, estimate: Estimate, admitted: Admitted) -> Any:
        """Table of ``/hat/status``."""
        e = estimate
        version = 0 if e.alignment is None else e.alignment.version
        head = [e.state, admitted.seq, e.keyframe, e.n_candidates, e.anchor, e.gate_weight]
        tail = [version, e.slam_epoch, e.gap_frames, admitted.dropped_total]
        row = np.concatenate([head, tail, e.pose_row, [e.reason], e.covariance[_UPPER], [e.order, e.free_axes]])
        return self.table(e.stamp_ns, frame_id, topics.STATUS_COLUMNS, row)


def _candidate_rows(candidates: Candidates) -> Float:
    n = len(candidates)
    boxes = np.broadcast_to(candidates.box_xyxy, (n, 4))
    return np.column_stack([candidates.pose_rows, candidates.log_score, candidates.rank, boxes])


def admitted_from(message: Any) -> Admitted:
    """Decode ``/hat/admission``."""
    row = one_row(message, topics.ADMISSION_COLUMNS)
    return Admitted(*(whole_number(name, row[name]) for name in topics.ADMISSION_COLUMNS))


def _candidates_from_rows(rows: Float) -> Candidates:
    if not len(rows):
        return Candidates.none()
    pose_rows, score, rank, boxes = rows[:, :7].copy(), rows[:, 7].copy(), rows[:, 8], rows[:, 9:13]
    if not (np.all(rank >= 0) and np.array_equal(rank, np.floor(rank)) and len(np.unique(rank)) == len(rank)):
        raise WireError(f"column 'rank' must hold different whole numbers from 0 on, found {rank.tolist()}")
    if not np.array_equal(boxes, np.broadcast_to(boxes[0], boxes.shape), equal_nan=True):
        raise WireError("columns bx0 by0 bx1 by1 must be the same in all rows of one frame")
    if np.isnan(score).any() or np.isposinf(score).any():
        raise WireError(f"column 'score' must be a number or -inf, found {score.tolist()}")
    check_poses(pose_rows[np.isfinite(score)])  # a dropped candidate keeps its slot, whatever is in it
    return Candidates(pose_rows, score, boxes[0].copy(), rank.astype(np.int64))


def candidates_from(message: Any) -> Candidates:
    """Decode ``/hat/hypotheses_scored``."""
    return _candidates_from_rows(read_table(message, topics.CANDIDATE_COLUMNS))


def selection_from(message: Any) -> Selection:
    """Decode ``/hat/selection``."""
    rows = read_table(message, topics.SELECTION_COLUMNS)
    candidates = _candidates_from_rows(rows)
    flags = rows[:, 15]
    if not np.isin(flags, (0.0, 1.0)).all() or flags.sum() > 1:
        raise WireError(f"column 'selected' must be 0 with at most one 1, found {flags.tolist()}")
    return Selection(candidates, rows[:, 13].copy(), rows[:, 14].copy(), int(np.argmax(flags)) if flags.any() else -1)


def motion_from(message: Any) -> Motion:
    """Decode ``/hat/slam_state``; ``sigma_rad`` is in ``/hat/slam_odometry`` alone."""
    row = one_row(message, topics.MOTION_COLUMNS)
    pose_row = np.array([row[name] for name in topics.POSE_COLUMNS])
    valid = flag("valid", row["valid"])
    if valid:
        check_poses(pose_row)
    return Motion(valid, whole_number("epoch", row["epoch"]), pose_row, whole_number("n_keyframes", row["n_keyframes"]))


def alignment_from(message: Any) -> Alignment:
    """Decode ``/hat/alignment``."""
    row = one_row(message, topics.ALIGNMENT_COLUMNS)
    if not (np.isfinite(row["scale"]) and row["scale"] > 0):
        raise WireError(f"column 'scale' must be positive, found {row['scale']}")
    quat_xyzw = np.array([row[name] for name in ("qx", "qy", "qz", "qw")])
    translation_m = np.array([row[name] for name in ("tx", "ty", "tz")])
    check_poses(np.concatenate([translation_m, quat_xyzw]))
    return Alignment(
        whole_number("version", row["version"], low=1),
        row["scale"],
        quat_xyzw,
        translation_m,
        whole_number("n_anchors", row["n_anchors"]),
        row["rms"],
        whole_number("epoch", row["epoch"]),
    )


def status_from(message: Any) -> Status:
    """Decode ``/hat/status``; the alignment has a topic of its own. Reason and covariance are missing in old bags."""
    row = one_row(message, topics.STATUS_COLUMNS, topics.N_STATUS_AT_FIRST)
    state = whole_number("state", row["state"])
    if state not in set(TrackState):
        raise WireError(f"column 'state' must be 0 to {max(TrackState)}, found {state}")
    reason = _count("reason", row, StateReason.UNSTATED)
    pose_row = np.array([row[name] for name in topics.POSE_COLUMNS])
    if TrackState(state).has_pose:
        check_poses(pose_row)
    estimate = Estimate(
        stamp_of(message),
        TrackState(state),
        pose_row,
        _covariance(row),
        keyframe=flag("keyframe", row["keyframe"]),
        n_candidates=whole_number("n_candidates", row["n_candidates"]),
        anchor=whole_number("anchor", row["anchor"], low=-1),
        gate_weight=row["gate_weight"],
        slam_epoch=whole_number("slam_epoch", row["slam_epoch"]),
        gap_frames=whole_number("gap_frames", row["gap_frames"]),
        order=_count("order", row, 1),
        free_axes=_count("free_axes", row, 0),
        # A reason that a newer writer knows is none to this reader.
        reason=StateReason(reason) if reason in set(StateReason) else StateReason.UNSTATED,
    )
    return Status(
        estimate,
        whole_number("seq", row["seq"]),
        whole_number("dropped_total", row["dropped_total"]),
        whole_number("alignment_version", row["alignment_version"]),
    )


def _count(name: str, row: dict[str, float], otherwise: int) -> int:
    """A whole number of a later column, or what stands for it where an older writer has none."""
    return otherwise if np.isnan(row[name]) else whole_number(name, row[name])


def _covariance(row: dict[str, float]) -> Float:
    """(6, 6) of a status row, NaN without one."""
    covariance = np.empty((6, 6))
    elements = [row[f"cov{i}{j}"] for i, j in zip(*_UPPER, strict=True)]
    covariance[_UPPER] = covariance.T[_UPPER] = elements
    return covariance
