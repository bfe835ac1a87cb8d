"""A run, frame by frame, as arrays: what the result bag holds, beside the ground truth where it is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from hat_ros.array_types import Bool, Float, Int
from hat_ros.geometry import lie
from hat_ros.types import Candidates, Estimate, Motion, TrackState


@dataclass(frozen=True)
class RunLog:
    """N admitted frames in stamp order; NaN, -1 or empty where a stage had no answer.

    Attributes:
        stamp_ns: (N,) exposure stamps.
        state: (N,) :class:`~hat_ros.types.TrackState` values.
        reason: (N,) :class:`~hat_ros.types.StateReason` values.
        pose_rows: (N, 7) output ``T_cam_target``.
        covariance: (N, 6, 6) of the output, ``[translation; rotation vector]``.
        keyframe: (N,) candidates were available.
        anchor: (N,) index of the selected candidate, -1 = none.
        gate_weight: (N,) g at anchors.
        alignment_version: (N,) version of the Sim(3) in force, 0 = none yet.
        slam_epoch: (N,) epoch of the motion.
        gap_frames: (N,) frames since the last measurement.
        dropped_total: frames known not to have been admitted (refused, or dropped live) when the last one was.
        candidates: N sets of hypotheses, empty between keyframes.
        motion_valid: (N,) a motion was known.
        motion_rows: (N, 7) ``T_slam_cam``.
        truth_rows: (N, 7) true ``T_cam_target``.
    """

    stamp_ns: Int
    state: Int
    reason: Int
    pose_rows: Float
    covariance: Float
    keyframe: Bool
    anchor: Int
    gate_weight: Float
    alignment_version: Int
    slam_epoch: Int
    gap_frames: Int
    dropped_total: int
    candidates: tuple[Candidates, ...]
    motion_valid: Bool
    motion_rows: Float
    truth_rows: Float

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @cached_property
    def T_est(self) -> Float:
        """(N, 4, 4) outputs, NaN where the state has none."""
        has = np.isin(self.state, [state for state in TrackState if state.has_pose])
        return lie.matrix_from_row(np.where(has[:, None], self.pose_rows, np.nan))

    @cached_property
    def T_true(self) -> Float:
        """(N, 4, 4) truth, NaN where there is none."""
        return lie.matrix_from_row(self.truth_rows)

    @cached_property
    def has_output(self) -> Bool:
        """(N,) there is a pose, published or not."""
        return np.asarray(np.isfinite(self.T_est).all(axis=(-1, -2)))

    @cached_property
    def has_truth(self) -> Bool:
        """(N,) the true pose is known."""
        return np.asarray(np.isfinite(self.truth_rows).all(axis=-1))

    @cached_property
    def reset(self) -> Bool:
        """(N,) the alignment was dropped at this frame, for disagreement or for a new SLAM epoch."""
        return (np.diff(self.alignment_version > 0, prepend=False)) & (self.alignment_version == 0)

    def anchor_errors_deg(self) -> Float:
        """(N,) rotation error of the selected candidate, NaN where none was selected."""
        out = np.full(len(self), np.nan)
        for i in np.flatnonzero((self.anchor >= 0) & self.has_truth):
            if self.anchor[i] < len(self.candidates[i]):
                R = lie.matrix_from_row(self.candidates[i].pose_rows[self.anchor[i]])[:3, :3]
                out[i] = np.degrees(lie.angle_between(R, self.T_true[i, :3, :3]))
        return out

    def motion(self, index: int) -> Motion:
        """What was known of the camera's motion at one frame."""
        if not self.motion_valid[index]:
            return Motion.none(int(self.slam_epoch[index]))
        return Motion(True, int(self.slam_epoch[index]), self.motion_rows[index])

    def with_truth(self, truth: Mapping[int, Float]) -> RunLog:
        """The same run beside another truth: exact stamp -> pose row (7,)."""
        nothing = np.full(7, np.nan)
        rows = np.array([truth.get(int(stamp), nothing) for stamp in self.stamp_ns]).reshape(-1, 7)
        return replace(self, truth_rows=rows)


class RunLogBuilder:
    """Collects the answers of the stages frame by frame; the same for a run in process and a recorded graph."""

    def __init__(self) -> None:
        self._rows: list[dict[str, Any]] = []
        self.dropped_total = 0

    def add(
        self, candidates: Candidates, motion: Motion, estimate: Estimate, alignment_version: int | None = None
    ) -> None:
        """Append one frame; stamps must increase. The version is needed where the estimate lacks its alignment."""
        if alignment_version is None:
            alignment_version = estimate.alignment.version if estimate.alignment else 0
        self._rows.append(
            {
                "stamp_ns": estimate.stamp_ns,
                "state": int(estimate.state),
                "reason": int(estimate.reason),
                "pose_rows": estimate.pose_row,
                "covariance": estimate.covariance,
                "keyframe": estimate.keyframe,
                "anchor": estimate.anchor,
                "gate_weight": estimate.gate_weight,
                "alignment_version": alignment_version,
                "slam_epoch": estimate.slam_epoch,
                "gap_frames": estimate.gap_frames,
                "candidates": candidates,
                "motion_valid": motion.valid,
                "motion_rows": motion.pose_row,
            }
        )

    def revise(self, estimates: Sequence[Estimate]) -> None:
        """Replace the outputs by those of a method that answers only after the last frame; no-op when empty."""
        for row, estimate in zip(self._rows, estimates, strict=bool(estimates)):
            row |= {
                "state": int(estimate.state),
                "reason": int(estimate.reason),
                "pose_rows": estimate.pose_row,
                "covariance": estimate.covariance,
                "anchor": estimate.anchor,
            }

    def build(self, truth: Mapping[int, Float] | None = None) -> RunLog:
        """The collected frames beside the truth (exact stamp -> pose row)."""
        shapes: dict[str, tuple[type, tuple[int, ...]]] = {
            "stamp_ns": (np.int64, ()),
            "state": (np.int64, ()),
            "reason": (np.int64, ()),
            "pose_rows": (np.float64, (7,)),
            "covariance": (np.float64, (6, 6)),
            "keyframe": (np.bool_, ()),
            "anchor": (np.int64, ()),
            "gate_weight": (np.float64, ()),
            "alignment_version": (np.int64, ()),
            "slam_epoch": (np.int64, ()),
            "gap_frames": (np.int64, ()),
            "motion_valid": (np.bool_, ()),
            "motion_rows": (np.float64, (7,)),
        }
        columns: dict[str, Any] = {
            name: np.array([row[name] for row in self._rows], dtype=kind).reshape((len(self._rows), *shape))
            for name, (kind, shape) in shapes.items()
        }
        log = RunLog(
            **columns,
            dropped_total=self.dropped_total,
            candidates=tuple(row["candidates"] for row in self._rows),
            truth_rows=np.full((len(self._rows), 7), np.nan),
        )
        return log.with_truth(truth or {})
