"""Stage 4a: the similarity from SLAM to metric target coordinates, eqs. (alignmentmap) and (alignmentfit).

The fit separates. With ``u = (R^A)^T t^A`` the two halves of the residual of one observation are

    lambda Log(R_M R^A R^S)                    which depends on R^A alone, and
    t_M - t_S = (R^S)^T (s t^S + u - c)        with c = -R^S t_M, linear in (s, u),

so the minimum of eq. (alignmentfit) is the mean of the rotations ``(R^S R_M)^T`` beside the straight-line regression
of c on t^S. It is the minimum that a Levenberg-Marquardt search over log-scale, rotation vector and translation
approaches (a test compares them), at a cost that allows thousands of observations. No nonlinear solver is
needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hat_ros.array_types import Bool, Float
from hat_ros.config import AlignmentConfig
from hat_ros.core.joint_history import JointHistory, relative_rotvecs
from hat_ros.geometry import lie
from hat_ros.types import Alignment

# A regression slope at or below zero is no similarity: the cost then falls towards scale zero, which this stands for.
_MIN_SCALE = 1e-9
# SLAM positions that spread less than this share of their distance from the origin determine no scale.
_MIN_RELATIVE_SPREAD = 1e-9


@dataclass(frozen=True)
class _Fit:
    """The unknowns of the fit: scale, R^A, and u = (R^A)^T t^A in metres along the SLAM axes."""

    scale: float
    quat_xyzw: Float
    offset_m: Float


class SlamAlignment:
    """Collects joint anchor/SLAM observations and keeps the similarity fitted to them.

    Attributes:
        current: the similarity in force, None before the first fit.
        n_observations: joint observations since the last :meth:`reset`.
    """

    def __init__(self, config: AlignmentConfig) -> None:
        self._config = config
        self._n_fits = 0
        self.reset()

    def reset(self) -> None:
        """Drop the similarity and its history."""
        self.current: Alignment | None = None
        self.n_observations = 0
        self._history = JointHistory(self._config.max_observations)
        self._frames_since_fit = 0

    def observe(self, T_cam_target: Float, T_slam_cam: Float) -> None:
        """Add an anchor and the SLAM pose of the same frame, (4, 4) each."""
        self.n_observations += 1
        self._history.append(T_cam_target, T_slam_cam)

    def update(self, epoch: int) -> None:
        """Count one input frame and fit when due.

        Due: as soon as ``min_observations`` exist, then ``refit_interval_frames`` input frames after the last fit.
        """
        self._frames_since_fit += 1
        if self.current is None:
            if self.n_observations < self._config.min_observations:
                return
            start = umeyama(self._history.slam_position, self._history.target_position)
            rounds = self._config.first_rejection_rounds
        elif self._frames_since_fit >= self._config.refit_interval_frames:
            start = (self.current.scale, self.current.quat_xyzw)
            rounds = self._config.refit_rejection_rounds
        else:
            return
        self._frames_since_fit = 0
        self._n_fits += 1
        self.current = self._robust_fit(*start, rounds, epoch)

    def _robust_fit(self, scale: float, quat_xyzw: Float, rounds: int, epoch: int) -> Alignment:
        """Fit to all observations, then again to those with small residuals, up to ``rounds`` times."""
        history, lever = self._history, self._config.lever_m_per_rad
        inliers = np.ones(len(history), dtype=bool)
        fit = _fit(history, inliers, scale, quat_xyzw)
        norms = _residual_norms(history, fit, lever)
        for _ in range(rounds):
            keep = norms < self._config.rejection_factor * np.median(norms[inliers])
            if np.count_nonzero(keep) < 3 or np.count_nonzero(keep) == np.count_nonzero(inliers):
                break
            inliers = keep
            fit = _fit(history, inliers, fit.scale, fit.quat_xyzw)
            norms = _residual_norms(history, fit, lever)
        history.inliers = inliers
        return Alignment(
            version=self._n_fits,
            scale=fit.scale,
            quat_xyzw=fit.quat_xyzw,
            translation_m=lie.matrix_from_quat(fit.quat_xyzw) @ fit.offset_m,
            n_anchors=history.folded_count + int(np.count_nonzero(inliers)),
            rms=float(np.sqrt(np.mean(norms[inliers] ** 2))),
            epoch=epoch,
        )


def _fit(history: JointHistory, rows: Bool, scale: float, quat_xyzw: Float) -> _Fit:
    """Minimum of eq. (alignmentfit) over the chosen rows and the fold; the start scale stays if nothing tells it."""
    moments = history.moments(rows)
    extent_sq = moments.count * float(moments.mean_slam @ moments.mean_slam) + moments.spread
    if moments.spread > extent_sq * _MIN_RELATIVE_SPREAD**2:
        scale = max(moments.covariation / moments.spread, _MIN_SCALE)
    offset_m = moments.mean_camera - scale * moments.mean_slam
    return _Fit(scale, history.rotation_mean(rows, quat_xyzw), offset_m)


def _residual_norms(history: JointHistory, fit: _Fit, lever_m_per_rad: float) -> Float:
    """Norm in metres of every stored observation's residual, lambda-weighted: (n,)."""
    rotvec = lever_m_per_rad * relative_rotvecs(history.relative_quat, fit.quat_xyzw)
    offset = fit.scale * history.slam_position + fit.offset_m - history.camera_position
    return np.sqrt(np.sum(rotvec * rotvec, axis=1) + np.sum(offset * offset, axis=1))


def umeyama(source: Float, destination: Float) -> tuple[float, Float]:
    """Scale and rotation of the similarity that maps source points onto destination points in least squares.

    Umeyama, IEEE TPAMI 13 (1991), eqs. (39)-(43). The translation is not needed by its callers.

    Args:
        source: (n, 3) points.
        destination: (n, 3) matching points.

    Returns:
        Scale (1 when the points determine none, as with a stationary camera) and rotation as (4,) quat_xyzw.
    """
    a, b = source - source.mean(axis=0), destination - destination.mean(axis=0)
    U, singular, Vt = np.linalg.svd(b.T @ a / len(source))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    spread = np.sum(a * a) / len(source)
    scale = float(singular @ sign / spread) if spread > 0 else 0.0
    quat_xyzw = lie.quat_from_matrix(U @ np.diag(sign) @ Vt)
    return (scale if np.isfinite(scale) and scale > 0 else 1.0), quat_xyzw
