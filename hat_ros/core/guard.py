"""What a pose hypothesis must look like before it may compete (paper: "with invalid candidates excluded").

Two policies. Dropping (Pico-HAT): an implausible candidate keeps its slot with the score ``-inf``, so that indices
still mean the same everywhere. Strict (Mega-HAT): its estimator cannot produce an implausible candidate, so a
non-finite score or a pose that is no rigid transform is an error.
"""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Bool, Float
from hat_ros.errors import CandidateError
from hat_ros.geometry import lie
from hat_ros.types import Candidates

MIN_RANGE_M = 1e-3
MAX_RANGE_M = 100.0
MAX_DEPTH_RATIO = 3.0
_QUAT_NORM_TOLERANCE = 1e-3


def candidates_from_recording(T_cam_target: Float, log_score: Float, box_xyxy: Float | None = None) -> Candidates:
    """Candidates in the order given, with NaN rows where a matrix is no rigid transform.

    Args:
        T_cam_target: (K, 4, 4) poses, anything.
        log_score: (K,) scores, anything.
        box_xyxy: (4,) detection box in pixels, None when unknown.
    """
    rigid = lie.is_rigid(T_cam_target)
    rows = np.full((len(T_cam_target), 7), np.nan)
    rows[rigid] = lie.row_from_matrix(T_cam_target[rigid])
    return Candidates(rows, log_score, np.full(4, np.nan) if box_xyxy is None else box_xyxy)


def guard_candidates(candidates: Candidates, drop: bool) -> Candidates:
    """Drop implausible candidates, or insist that there are none.

    Args:
        candidates: what the estimator returned.
        drop: True gives implausible candidates the score ``-inf`` (their slot stays; a pose that is not finite is
            replaced by the identity, so that no NaN travels on); False checks and returns them unchanged.

    Raises:
        CandidateError: ``drop`` is False and a score is not finite or a pose is no rigid transform.
    """
    valid_pose = _rigid_rows(candidates.pose_rows)
    if not drop:
        _insist(candidates, valid_pose)
        return candidates
    keep = valid_pose & np.isfinite(candidates.log_score) & (candidates.log_score > 0)
    position_m = np.where(keep[:, None], candidates.pose_rows[:, :3], 0.0)
    depth_m, range_m = position_m[:, 2], np.linalg.norm(position_m, axis=1)
    keep &= (depth_m > 0) & (range_m >= MIN_RANGE_M) & (range_m <= MAX_RANGE_M)
    if np.count_nonzero(keep) >= 3:
        median_m = np.median(depth_m[keep])
        keep &= (depth_m >= median_m / MAX_DEPTH_RATIO) & (depth_m <= median_m * MAX_DEPTH_RATIO)
    rows = np.where(valid_pose[:, None], candidates.pose_rows, np.array([0.0, 0, 0, 0, 0, 0, 1]))
    return Candidates(rows, np.where(keep, candidates.log_score, -np.inf), candidates.box_xyxy, candidates.rank)


def _rigid_rows(pose_rows: Float) -> Bool:
    finite: Bool = np.all(np.isfinite(pose_rows), axis=1)
    norm = np.linalg.norm(np.where(finite[:, None], pose_rows[:, 3:], 0.0), axis=1)
    return finite & (np.abs(norm - 1.0) < _QUAT_NORM_TOLERANCE)


def _insist(candidates: Candidates, valid_pose: Bool) -> None:
    finite_score = np.isfinite(candidates.log_score)
    if not finite_score.all():
        index = int(np.argmin(finite_score))
        raise CandidateError(
            f"candidate {index}: its score is {candidates.log_score[index]}, expected a finite number; "
            f"set hypotheses.guard=true to drop such candidates"
        )
    if not valid_pose.all():
        index = int(np.argmin(valid_pose))
        raise CandidateError(
            f"candidate {index}: its pose is not a finite rigid transform; "
            f"set hypotheses.guard=true to drop such candidates"
        )
