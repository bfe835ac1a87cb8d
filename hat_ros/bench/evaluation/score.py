"""The figures of ``metrics.json``, from a run and its ground truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.evaluation import metrics
from hat_ros.bench.evaluation.symmetric import average_recalls, mspd, mssd, nearest_truth
from hat_ros.geometry.symmetry import Symmetry
from hat_ros.io.run_log import RunLog
from hat_ros.target.exact_symmetry import symmetry_of
from hat_ros.target.model import Target
from hat_ros.types import Camera, StateReason, TrackState

# Surface points of ADD-S; more change its third digit at most.
ADD_S_POINTS = 1000
# Figures that are given for the nearest equal of the truth, too.
_SYMMETRIC = ("E_p_mean", "E_p_sd", "E_t_m_mean", "E_q_deg_mean")


def score_run(
    log: RunLog,
    target: Target | None = None,
    played: int | None = None,
    refused: int = 0,
    camera: Camera | None = None,
) -> dict[str, Any]:
    """Every figure that a run and its ground truth give; without ground truth the errors are NaN.

    E_p, E_t and E_q are the paper's. What is said of states, covariance and hypotheses is held against the nearest of
    the poses that no image can tell from the truth, and so are the figures named ``_sym``, MSSD and MSPD.

    Args:
        log: the run.
        target: the CAD model, for its symmetry, ADD-S, MSSD and MSPD.
        played: frames of the recording that the run was given; None = not known, those that the log knows of.
        refused: how many of them were refused; the others that have no answer were dropped.
        camera: calibration, for MSPD.

    Returns:
        Plain numbers and lists under the names of ``metrics.json``.
    """
    errors = metrics.pose_errors(log.T_est, log.T_true)
    symmetry = Symmetry() if target is None else symmetry_of(target)
    T_equal = nearest_truth(log.T_est, log.T_true, symmetry)
    to_equal = metrics.pose_errors(log.T_est, T_equal)
    inside = metrics.inside_ellipsoid(log.T_est, log.covariance, T_equal)
    steps = metrics.relative_motion_deg(log.motion_rows, log.motion_valid, log.slam_epoch, log.T_true)
    keyframes = np.flatnonzero(log.keyframe)
    unanswered = log.dropped_total if played is None else max(0, played - len(log))
    out: dict[str, Any] = {"frames": len(log) + unanswered, "refused": refused, "dropped": unanswered - refused}
    out |= metrics.coverage(log.has_output, log.has_truth, unanswered)
    out |= metrics.summarise(errors)
    equal = metrics.summarise(to_equal)
    out |= {f"{name[:3]}_sym{name[3:]}": equal[name] for name in _SYMMETRIC}
    out |= {"symmetry_order": symmetry.order, "symmetry_free_axes": len(symmetry.axes)}
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
        "untrue_tracking_share": metrics.untrue_tracking_share(log.state, to_equal),
        "inside_95_share": float(np.mean(inside)) if len(inside) else float("nan"),
        "depth_energy_share": metrics.depth_energy_share(log.T_est, log.T_true),
    }
    nearest = [log.candidates[i].nearest(symmetry, log.T_true[i, :3, :3]).pose_rows for i in keyframes]
    out |= metrics.candidate_oracle(nearest, log.T_true[keyframes])
    if target is not None and errors.scored.any():
        distances = metrics.add_s(surface_points(target), log.T_est, log.T_true)
        out["ADD_S_m_mean"] = float(np.nanmean(distances))
        # The customary threshold: a tenth of the diameter.
        out["ADD_S_10_share"] = float(np.mean(distances[errors.scored] < 0.1 * target.diameter_m))
        if camera is not None:
            out |= _bop_errors(log, target, symmetry, camera, out["targets"])
    out["range_bins"] = metrics.range_bins(log.T_est, log.T_true)
    return out


def _bop_errors(log: RunLog, target: Target, symmetry: Symmetry, camera: Camera, targets: int) -> dict[str, float]:
    """The errors of the BOP challenge: means over the scored frames, recalls over all targets."""
    surface, image = (
        mssd(log.T_est, log.T_true, target, symmetry),
        mspd(log.T_est, log.T_true, target, symmetry, camera),
    )
    means = {"MSSD_m_mean": float(np.nanmean(surface)), "MSPD_px_mean": float(np.nanmean(image))}
    return means | average_recalls(surface, image, target.diameter_m, camera.width, targets)


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
