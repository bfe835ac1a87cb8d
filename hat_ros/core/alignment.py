"""Stage 4a: the similarity from SLAM to metric target coordinates, eqs. (alignmentmap) and (alignmentfit).

The fit separates. With ``u = (R^A)^T t^A`` the two halves of the residual of one observation are

    lambda Log(R_M R^A R^S)                    which depends on R^A alone, and
    t_M - t_S = (R^S)^T (s t^S + u - c)        with c = -R^S t_M, linear in (s, u),

so the minimum of eq. (alignmentfit) is the mean of the rotations ``(R^S R_M)^T`` beside the straight-line regression
of c on t^S. It is the minimum that a Levenberg-Marquardt search over log-scale, rotation vector and translation
approaches (a test compares them), at a cost that allows thousands of observations. No nonlinear solver is
needed, but for one thing: the rotations of a first fit may contradict each other, their mean has several local minima
then, and the search over all seven parameters says which one is meant.
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
# Rotations within a quarter turn of their mean have one mean only (Karcher, Comm. Pure Appl. Math. 30, 1977).
_ONE_MEAN_RAD = np.pi / 2
# Least median residual in metres that outliers are told by, as in the authors' reference: exact data have none.
_MIN_MEDIAN_M = 1e-6


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
        n_observations: joint observations since the last :meth:`reset`, without those that do not count.
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
        self._newest = _Fit(1.0, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
        self._frames_since_fit = 0

    def observe(self, T_cam_target: Float, T_slam_cam: Float, counts: bool = True) -> None:
        """Add an anchor and the SLAM pose of the same frame, (4, 4) each.

        Args:
            counts: whether it brings the first fit, and fusion, nearer; it is fitted to in any case.
        """
        self.n_observations += counts
        self._history.append(T_cam_target, T_slam_cam)

    def update(self, epoch: int) -> None:
        """Count one input frame and fit when due.

        Due: as soon as ``min_observations`` exist, then ``refit_interval_frames`` input frames after the last fit.
        """
        self._frames_since_fit += 1
        if self.current is None:
            if self.n_observations < self._config.min_observations:
                return
            fit, rounds = _provisional(self._history), self._config.first_rejection_rounds
        elif self._frames_since_fit >= self._config.refit_interval_frames:
            fit, rounds = self._newest, self._config.refit_rejection_rounds
        else:
            return
        self._frames_since_fit = 0
        self._n_fits += 1
        self.current = self._robust_fit(fit, rounds, epoch)

    def _robust_fit(self, fit: _Fit, rounds: int, epoch: int) -> Alignment:
        """Fit to all observations, then up to ``rounds`` times again to those with small residuals.

        Every call begins with all observations: what an earlier one rejected is forgotten.
        """
        history, lever, first = self._history, self._config.lever_m_per_rad, self.current is None
        inliers = np.ones(len(history), dtype=bool)
        fit = _fit(history, inliers, fit, lever, first)
        norms = _residual_norms(history, fit, lever)
        for _ in range(rounds):
            keep = norms < self._config.rejection_factor * max(float(np.median(norms[inliers])), _MIN_MEDIAN_M)
            if np.count_nonzero(keep) < 3 or np.count_nonzero(keep) == np.count_nonzero(inliers):
                break
            inliers = keep
            fit = _fit(history, inliers, fit, lever, first)
            norms = _residual_norms(history, fit, lever)
        history.inliers, self._newest = inliers, fit
        return Alignment(
            version=self._n_fits,
            scale=fit.scale,
            quat_xyzw=fit.quat_xyzw,
            translation_m=lie.matrix_from_quat(fit.quat_xyzw) @ fit.offset_m,
            n_anchors=history.folded_count + int(np.count_nonzero(inliers)),
            rms=float(np.sqrt(np.mean(norms[inliers] ** 2))),
            epoch=epoch,
        )


def _provisional(history: JointHistory) -> _Fit:
    """Umeyama's similarity of the camera's positions, from which a first fit starts."""
    scale, quat_xyzw = umeyama(history.slam_position, history.target_position)
    R = lie.matrix_from_quat(quat_xyzw)
    offset_m = R.T @ history.target_position.mean(axis=0) - scale * history.slam_position.mean(axis=0)
    return _Fit(scale, quat_xyzw, offset_m)


def _fit(history: JointHistory, rows: Bool, start: _Fit, lever_m_per_rad: float, first: bool) -> _Fit:
    """Minimum of eq. (alignmentfit) over the chosen rows and the fold; the start scale stays if nothing tells it."""
    moments = history.moments(rows)
    extent_sq = moments.count * float(moments.mean_slam @ moments.mean_slam) + moments.spread
    scale = start.scale
    if moments.spread > extent_sq * _MIN_RELATIVE_SPREAD**2:
        scale = max(moments.covariation / moments.spread, _MIN_SCALE)
    offset_m = moments.mean_camera - scale * moments.mean_slam
    quat_xyzw = history.rotation_mean(rows, start.quat_xyzw)
    if first and _rotation_angles(history, quat_xyzw)[rows].max() > _ONE_MEAN_RAD:
        quat_xyzw = history.rotation_mean(rows, _searched_rotation(history, rows, start, lever_m_per_rad))
    return _Fit(scale, quat_xyzw, offset_m)


def _rotation_angles(history: JointHistory, quat_xyzw: Float) -> Float:
    """Angle in radians of every stored reading of R^A from a rotation: (n,)."""
    return np.linalg.norm(relative_rotvecs(history.relative_quat, quat_xyzw), axis=1)


def _searched_rotation(history: JointHistory, rows: Bool, start: _Fit, lever_m_per_rad: float) -> Float:
    """Rotation (4,) at which the published Levenberg-Marquardt search ends: log-scale, rotation vector, translation."""
    from scipy.optimize import least_squares  # a tenth of a second to import, for a rare case

    relative, slam, camera = history.relative_quat[rows], history.slam_position[rows], history.camera_position[rows]

    def residuals(parameters: Float) -> Float:
        R = lie.so3_exp(parameters[1:4])
        turn = lever_m_per_rad * relative_rotvecs(relative, lie.quat_from_matrix(R))
        shift = np.exp(parameters[0]) * slam + R.T @ parameters[4:] - camera
        return np.concatenate([turn, shift], axis=1).ravel()

    R = lie.matrix_from_quat(start.quat_xyzw)
    found = least_squares(
        residuals, np.concatenate([[np.log(start.scale)], lie.so3_log(R), R @ start.offset_m]), method="lm"
    )
    return lie.quat_from_matrix(lie.so3_exp(found.x[1:4]))


def _residual_norms(history: JointHistory, fit: _Fit, lever_m_per_rad: float) -> Float:
    """Norm in metres of every stored observation's residual, lambda-weighted: (n,)."""
    rotvec = lever_m_per_rad * relative_rotvecs(history.relative_quat, fit.quat_xyzw)
    offset = fit.scale * history.slam_position + fit.offset_m - history.camera_position
    return np.sqrt(np.sum(rotvec * rotvec, axis=1) + np.sum(offset * offset, axis=1))


def umeyama(source: Float, destination: Float) -> tuple[float, Float]:
    """Scale and rotation of the similarity that maps source points onto destination points in least squares.

    Umeyama, IEEE TPAMI 13 (1991), eqs. (39)-(43); the translation follows from the means.

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
