"""The figures of the paper's evaluation and the diagnostics around them: pure functions of arrays.

Conventions: N frames in order; poses are ``T_cam_target`` (N, 4, 4) in metres, NaN where there is no output or no
ground truth. A missing output lowers the coverage and is never an error of zero; means, standard deviations (ddof = 1)
and shares are taken over the frames that have both. A figure that has no data is NaN here and null in JSON.

Sources: E_t, E_q, E_p are the equations of the paper's section "Experimental Setup and Evaluation Metric"; ADD-S
after Xiang et al., PoseCNN (RSS 2018), section V-C; range bins after the paper's "Range-Dependent Rotation and Depth
Errors".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import chi2

from hat_ros.array_types import Bool, Float, Int
from hat_ros.geometry import lie
from hat_ros.types import TrackState

# A rotation further off than this lies in another orientation basin (paper: the share above 90 degrees).
WRONG_BASIN_DEG = 90.0
# An output further off than this must not be called TRACKING.
FALSE_TRACKING_DEG = 30.0


@dataclass(frozen=True)
class PoseErrors:
    """Errors per frame; NaN where the output or the ground truth is missing.

    Attributes:
        translation_m: (N,) E_t.
        rotation_rad: (N,) E_q, in [0, pi].
        pose: (N,) E_p = E_q + E_t / |T|, radians plus a ratio.
    """

    translation_m: Float
    rotation_rad: Float
    pose: Float

    @property
    def scored(self) -> Bool:
        """(N,) frames with both an output and a ground truth."""
        return np.isfinite(self.pose)


def pose_errors(T_est: Float, T_true: Float) -> PoseErrors:
    """E_t, E_q and E_p of every frame: (N, 4, 4), (N, 4, 4) -> (N,) each."""
    T_est, T_true = np.asarray(T_est, dtype=np.float64), np.asarray(T_true, dtype=np.float64)
    both = np.isfinite(T_est).all(axis=(-1, -2)) & np.isfinite(T_true).all(axis=(-1, -2))
    translation, rotation, pose = (np.full(len(T_est), np.nan) for _ in range(3))
    true_t = T_true[both, :3, 3]
    translation[both] = np.linalg.norm(T_est[both, :3, 3] - true_t, axis=-1)
    rotation[both] = lie.angle_between(T_est[both, :3, :3], T_true[both, :3, :3])
    pose[both] = rotation[both] + translation[both] / np.linalg.norm(true_t, axis=-1)
    return PoseErrors(translation, rotation, pose)


def _mean(values: Float) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _sd(values: Float) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def _median(values: Float) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _share(flags: Bool) -> float:
    return float(np.mean(flags)) if len(flags) else float("nan")


def summarise(errors: PoseErrors) -> dict[str, float]:
    """Means and sample SDs of the scored frames, under the names of ``metrics.json``."""
    scored = errors.scored
    e_p, e_t, e_q = errors.pose[scored], errors.translation_m[scored], np.degrees(errors.rotation_rad[scored])
    return {
        "E_p_mean": _mean(e_p),
        "E_p_sd": _sd(e_p),
        "E_p_median": _median(e_p),
        "E_t_m_mean": _mean(e_t),
        "E_t_m_sd": _sd(e_t),
        "E_q_deg_mean": _mean(e_q),
        "E_q_deg_sd": _sd(e_q),
        "E_q_deg_median": _median(e_q),
        "E_q_over_90_share": _share(e_q > WRONG_BASIN_DEG),
    }


def coverage(has_output: Bool, has_truth: Bool, unanswered: int = 0) -> dict[str, Any]:
    """Targets, valid outputs and their share.

    Args:
        has_output: (N,) admitted frames with a pose.
        has_truth: (N,) admitted frames with ground truth; where there is none at all, every frame is a target.
        unanswered: frames that were refused or dropped; every one is a target without a pose.
    """
    targets = has_truth if has_truth.any() else np.ones(len(has_output), dtype=bool)
    valid = int(np.count_nonzero(has_output & targets))
    n_targets = int(np.count_nonzero(targets)) + unanswered
    return {"targets": n_targets, "valid": valid, "coverage": valid / n_targets if n_targets else float("nan")}


def add_s(points: Float, T_est: Float, T_true: Float) -> Float:
    """ADD-S in metres: mean distance from each true point to the nearest estimated one.

    Args:
        points: (P, 3) points of the CAD surface, target frame, metres.
        T_est: (N, 4, 4) outputs.
        T_true: (N, 4, 4) ground truth.

    Returns:
        (N,) metres, NaN where output or ground truth is missing.
    """
    out = np.full(len(T_est), np.nan)
    tree = cKDTree(points)
    for i in np.flatnonzero(np.isfinite(T_est).all(axis=(-1, -2)) & np.isfinite(T_true).all(axis=(-1, -2))):
        relative = lie.inverse(T_est[i]) @ T_true[i]  # nearest neighbours need no rigid motion of the tree
        out[i] = np.mean(tree.query(points @ relative[:3, :3].T + relative[:3, 3])[0])
    return out


def best_of_k_deg(candidates: Sequence[Float], T_true: Float) -> Float:
    """Rotation error of the best candidate of each frame, an oracle over the hypotheses.

    Args:
        candidates: N arrays of pose rows (K_i, 7); rows that are not finite are ignored.
        T_true: (N, 4, 4).

    Returns:
        (N,) degrees; NaN without ground truth, and 180 (nothing could be worse) where it exists but no candidate does.
    """
    out = np.full(len(candidates), np.nan)
    for i, rows in enumerate(candidates):
        if not np.isfinite(T_true[i]).all():
            continue
        rows = rows[np.isfinite(rows).all(axis=-1)]
        R = lie.matrix_from_row(rows)[:, :3, :3]
        out[i] = np.degrees(lie.angle_between(R, T_true[i, :3, :3]).min()) if len(rows) else 180.0
    return out


def candidate_oracle(candidates: Sequence[Float], T_true: Float) -> dict[str, float]:
    """Recall of the hypotheses at keyframes: best of K within 15 and 30 degrees, its median."""
    best = best_of_k_deg(candidates, T_true)
    best = best[np.isfinite(best)]
    return {
        "oracle_keyframes": len(best),
        "oracle_within_15_share": _share(best <= 15.0),
        "oracle_within_30_share": _share(best <= 30.0),
        "oracle_median_deg": _median(best),
    }


def range_bins(T_est: Float, T_true: Float, width_m: float = 2.0) -> list[dict[str, float]]:
    """Rotation and signed depth error by bins of true depth, and depth's share of the translation-error energy.

    Args:
        T_est: (N, 4, 4) outputs.
        T_true: (N, 4, 4) ground truth.
        width_m: bin width in metres.

    Returns:
        One mapping per non-empty bin, nearest first; quartiles are the 25th, 50th and 75th percentile.
    """
    scored = pose_errors(T_est, T_true).scored
    if not scored.any():
        return []
    rotation = np.degrees(lie.angle_between(T_est[scored, :3, :3], T_true[scored, :3, :3]))
    offset = T_est[scored, :3, 3] - T_true[scored, :3, 3]
    bins = np.floor(T_true[scored, 2, 3] / width_m).astype(int)
    out = []
    for index in np.unique(bins):
        here = bins == index
        q_rot = np.percentile(rotation[here], (25, 50, 75))
        q_depth = np.percentile(offset[here, 2], (25, 50, 75))
        out.append(
            {
                "depth_from_m": float(index * width_m),
                "depth_to_m": float((index + 1) * width_m),
                "frames": int(np.count_nonzero(here)),
                "rotation_deg_q25": float(q_rot[0]),
                "rotation_deg_median": float(q_rot[1]),
                "rotation_deg_q75": float(q_rot[2]),
                "depth_m_q25": float(q_depth[0]),
                "depth_m_median": float(q_depth[1]),
                "depth_m_q75": float(q_depth[2]),
                "over_90_share": _share(rotation[here] > WRONG_BASIN_DEG),
            }
        )
    return out


def depth_energy_share(T_est: Float, T_true: Float) -> float:
    """Share of the squared translation error that lies along the optical axis."""
    scored = pose_errors(T_est, T_true).scored
    offset = T_est[scored, :3, 3] - T_true[scored, :3, 3]
    energy = np.sum(offset**2)
    return float(np.sum(offset[:, 2] ** 2) / energy) if energy > 0 else float("nan")


def inside_ellipsoid(T_est: Float, covariance: Float, T_true: Float, probability: float = 0.95) -> Bool:
    """Whether the ground truth lies inside the stated confidence ellipsoid.

    Frames without covariance or ground truth are left out.

    Args:
        T_est: (N, 4, 4) outputs.
        covariance: (N, 6, 6) of ``[translation; rotation vector]`` with ``R_true = Exp(rotvec) R_est``.
        T_true: (N, 4, 4) ground truth.
        probability: mass of the ellipsoid.

    Returns:
        (M,) flags of the M <= N frames that can be judged. A singular covariance claims certainty: it counts as
        outside unless the error is zero.
    """
    covariance = np.asarray(covariance, dtype=np.float64)
    usable = pose_errors(T_est, T_true).scored & np.isfinite(covariance).all(axis=(-1, -2))
    limit = chi2.ppf(probability, df=6)
    inside = []
    for i in np.flatnonzero(usable):
        error = np.concatenate(
            [T_true[i, :3, 3] - T_est[i, :3, 3], lie.so3_log(T_true[i, :3, :3] @ T_est[i, :3, :3].T)]
        )
        values, vectors = np.linalg.eigh(0.5 * (covariance[i] + covariance[i].T))
        along = vectors.T @ error
        flat = values <= 0
        if np.any(np.abs(along[flat]) > 0):
            inside.append(False)
        else:
            inside.append(bool(np.sum(along[~flat] ** 2 / values[~flat]) <= limit))
    return np.array(inside, dtype=bool)


def untrue_tracking_share(states: Int, errors: PoseErrors, limit_deg: float = FALSE_TRACKING_DEG) -> float:
    """Share of the frames more than ``limit_deg`` off that are called TRACKING; NaN if there is no such frame."""
    far = errors.scored & (np.degrees(np.nan_to_num(errors.rotation_rad)) > limit_deg)
    return _share(states[far] == TrackState.TRACKING)


def relative_motion_deg(pose_rows: Float, valid: Bool, epoch: Int, T_true: Float) -> Float:
    """Rotation error of the motion estimate from each frame to the next, eq. (increment).

    Args:
        pose_rows: (N, 7) ``T_slam_cam``.
        valid: (N,) whether a motion is known.
        epoch: (N,) SLAM epochs; steps across epochs mean nothing.
        T_true: (N, 4, 4) ``T_cam_target``.

    Returns:
        (M,) degrees of the steps that can be judged.
    """
    known: Bool = valid & np.isfinite(T_true).all(axis=(-1, -2))
    usable = known[1:] & known[:-1] & (epoch[1:] == epoch[:-1])
    R_slam = lie.matrix_from_row(np.where(valid[:, None], pose_rows, lie.row_from_matrix(np.eye(4))))[:, :3, :3]
    step = np.swapaxes(R_slam[1:], -1, -2) @ R_slam[:-1]
    R_true = T_true[:, :3, :3]
    step_true = R_true[1:] @ np.swapaxes(R_true[:-1], -1, -2)
    return np.degrees(lie.angle_between(step[usable], step_true[usable]))


def mask_summary(iou: Float) -> dict[str, float]:
    """Mean overlap and share of frames at 0.9 or better."""
    iou = iou[np.isfinite(iou)]
    return {"mask_iou_mean": _mean(iou), "mask_iou_over_0_9_share": _share(iou >= 0.9)}
