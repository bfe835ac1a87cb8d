"""The figures of ``metrics.json``, from a run and its ground truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.evaluation import metrics
from hat_ros.io.run_log import RunLog
from hat_ros.target.model import Target
from hat_ros.types import StateReason, TrackState

# Surface points of ADD-S; more change its third digit at most.
ADD_S_POINTS = 1000


def score_run(log: RunLog, target: Target | None = None, played: int | None = None, refused: int = 0) -> dict[str, Any]:
    """Every figure that a run and its ground truth give; without ground truth the errors are NaN.

    Args:
        log: the run.
        target: the CAD model, for ADD-S.
        played: frames of the recording that the run was given; None = not known, those that the log knows of.
        refused: how many of them were refused; the others that have no answer were dropped.

    Returns:
        Plain numbers and lists under the names of ``metrics.json``.
    """
    errors = metrics.pose_errors(log.T_est, log.T_true)
    inside = metrics.inside_ellipsoid(log.T_est, log.covariance, log.T_true)
    steps = metrics.relative_motion_deg(log.motion_rows, log.motion_valid, log.slam_epoch, log.T_true)
    keyframes = np.flatnonzero(log.keyframe)
    unanswered = log.dropped_total if played is None else max(0, played - len(log))
    out: dict[str, Any] = {"frames": len(log) + unanswered, "refused": refused, "dropped": unanswered - refused}
    out |= metrics.coverage(log.has_output, log.has_truth, unanswered)
    out |= metrics.summarise(errors)
    out |= {f"state_{state.name.lower()}": int(np.count_nonzero(log.state == state)) for state in TrackState}
    reasons, frames = np.unique(log.reason, return_counts=True)
    out["reasons"] = {StateReason(int(r)).name.lower(): int(n) for r, n in zip(reasons, frames, strict=True)}
    out |= {
        "keyframes": len(keyframes),
        "resets": int(np.count_nonzero(log.reset)),
        "slam_epochs": int(np.count_nonzero(np.diff(log.slam_epoch) != 0)) + 1 if len(log) else 0,
        "motion_valid_share": float(np.mean(log.motion_valid)) if len(log) else float("nan"),
        "relative_motion_deg_median": float(np.median(steps)) if len(steps) else float("nan"),
        "relative_motion_deg_p90": float(np.percentile(steps, 90)) if len(steps) else float("nan"),
        "untrue_tracking_share": metrics.untrue_tracking_share(log.state, errors),
        "inside_95_share": float(np.mean(inside)) if len(inside) else float("nan"),
        "depth_energy_share": metrics.depth_energy_share(log.T_est, log.T_true),
    }
    out |= metrics.candidate_oracle([log.candidates[i].pose_rows for i in keyframes], log.T_true[keyframes])
    if target is not None and errors.scored.any():
        distances = metrics.add_s(surface_points(target), log.T_est, log.T_true)
        out["ADD_S_m_mean"] = float(np.nanmean(distances))
        # The customary threshold: a tenth of the diameter.
        out["ADD_S_10_share"] = float(np.mean(distances[errors.scored] < 0.1 * target.diameter_m))
    out["range_bins"] = metrics.range_bins(log.T_est, log.T_true)
    return out


def surface_points(target: Target, count: int = ADD_S_POINTS) -> Float:
    """``count`` points spread over the surface by area, the same for every process: (P, 3) metres."""
    corners, areas = target.corners_m, target.face_areas_m2
    rng = np.random.default_rng(0)
    face = rng.choice(len(areas), size=count, p=areas / areas.sum())
    a, b = rng.random((2, count))
    flip = a + b > 1
    a[flip], b[flip] = 1 - a[flip], 1 - b[flip]
    origin = corners[face, 0]
    return origin + a[:, None] * (corners[face, 1] - origin) + b[:, None] * (corners[face, 2] - origin)
