"""The joint anchor/SLAM observations behind the alignment, in bounded memory.

Observations are kept one by one up to a capacity. Beyond it the older half is folded: of its inliers remain one
weighted rotation mean and the exact moments of the scale regression.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hat_ros.array_types import Bool, Float
from hat_ros.geometry import lie

_MEAN_TOLERANCE_RAD = 1e-14
_MEAN_MAX_STEPS = 200


@dataclass(frozen=True)
class Moments:
    """First and second moments of paired positions, mergeable.

    Attributes:
        count: pairs.
        mean_slam: (3,) mean of t^S, SLAM units.
        mean_camera: (3,) mean of c, metres.
        spread: sum of |t^S - mean|^2.
        covariation: sum of (t^S - mean) . (c - mean).
    """

    count: int
    mean_slam: Float
    mean_camera: Float
    spread: float
    covariation: float

    @classmethod
    def of(cls, slam_position: Float, camera_position: Float) -> Moments:
        """Moments of (n, 3) SLAM positions paired with (n, 3) camera positions."""
        n = len(slam_position)
        if n == 0:
            return cls(0, np.zeros(3), np.zeros(3), 0.0, 0.0)
        mean_slam, mean_camera = slam_position.mean(axis=0), camera_position.mean(axis=0)
        d = slam_position - mean_slam
        return cls(n, mean_slam, mean_camera, float(np.sum(d * d)), float(np.sum(d * (camera_position - mean_camera))))

    def merged(self, other: Moments) -> Moments:
        """Moments of both sets together (Chan, Golub, LeVeque, The American Statistician 37, 1983)."""
        if self.count == 0 or other.count == 0:
            return other if self.count == 0 else self
        n = self.count + other.count
        step_slam, step_camera = other.mean_slam - self.mean_slam, other.mean_camera - self.mean_camera
        weight = self.count * other.count / n
        return Moments(
            n,
            self.mean_slam + step_slam * (other.count / n),
            self.mean_camera + step_camera * (other.count / n),
            self.spread + other.spread + weight * float(step_slam @ step_slam),
            self.covariation + other.covariation + weight * float(step_slam @ step_camera),
        )


class JointHistory:
    """Joint observations in arrival order, at most ``capacity`` of them, beside the fold of older inliers.

    Attributes:
        inliers: the last fit's inliers among the observations that it saw, (n_fitted,) bool; set by the fit.
        folded_count: observations folded.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._data = np.zeros((min(capacity, 64), 13))
        self._n = 0
        self.inliers = np.ones(0, dtype=bool)
        self.folded_count = 0
        self._folded_quat = np.array([0.0, 0.0, 0.0, 1.0])
        self._folded_moments = Moments.of(np.zeros((0, 3)), np.zeros((0, 3)))

    def __len__(self) -> int:
        return self._n

    @property
    def relative_quat(self) -> Float:
        """(n, 4) xyzw of (R^S R_M)^T: every one a reading of R^A."""
        return self._data[: self._n, 0:4]

    @property
    def slam_position(self) -> Float:
        """(n, 3) t^S in SLAM units."""
        return self._data[: self._n, 4:7]

    @property
    def camera_position(self) -> Float:
        """(n, 3) c = -R^S t_M: from target to camera, metres along the SLAM axes."""
        return self._data[: self._n, 7:10]

    @property
    def target_position(self) -> Float:
        """(n, 3) camera centre in target coordinates, metres."""
        return self._data[: self._n, 10:13]

    def append(self, T_cam_target: Float, T_slam_cam: Float) -> None:
        """Store one observation, (4, 4) each; folds first when full."""
        if self._n == self._capacity:
            self._fold(self._capacity // 2)
        if self._n == len(self._data):
            self._data = np.concatenate([self._data, np.zeros_like(self._data)])[: self._capacity]
        row = self._data[self._n]
        row[0:4] = lie.quat_from_matrix((T_slam_cam[:3, :3] @ T_cam_target[:3, :3]).T)
        row[4:7] = T_slam_cam[:3, 3]
        row[7:10] = -T_slam_cam[:3, :3] @ T_cam_target[:3, 3]
        row[10:13] = -T_cam_target[:3, :3].T @ T_cam_target[:3, 3]
        self._n += 1

    def moments(self, rows: Bool) -> Moments:
        """Moments of the chosen rows and everything folded."""
        return self._folded_moments.merged(Moments.of(self.slam_position[rows], self.camera_position[rows]))

    def rotation_mean(self, rows: Bool, start_quat: Float) -> Float:
        """(4,) mean of the chosen rows' rotations and everything folded, from ``start_quat``."""
        quats, weights = self.relative_quat[rows], np.ones(np.count_nonzero(rows))
        if self.folded_count:
            quats = np.vstack([self._folded_quat, quats])
            weights = np.concatenate([[float(self.folded_count)], weights])
        return rotation_mean(quats, weights, start_quat)

    def _fold(self, n_old: int) -> None:
        rows = np.zeros(self._n, dtype=bool)
        rows[:n_old] = True
        known = min(n_old, len(self.inliers))
        rows[:known] = self.inliers[:known]
        if rows.any():
            start = self._folded_quat if self.folded_count else self.relative_quat[np.argmax(rows)]
            self._folded_quat = self.rotation_mean(rows, start)
            self._folded_moments = self.moments(rows)
            self.folded_count = self._folded_moments.count
        self._data[: self._n - n_old] = self._data[n_old : self._n].copy()
        self._n -= n_old
        self.inliers = self.inliers[n_old:]


def relative_rotvecs(quats: Float, reference_quat: Float) -> Float:
    """Log(R_ref^T R_i) of unit quaternions xyzw: (n, 4), (4,) -> (n, 3) rad, angle in [0, pi]."""
    x, y, z, w = reference_quat
    # Matrix of q -> conj(q_ref) * q on xyzw columns.
    conjugate_times = np.array([[w, z, -y, -x], [-z, w, x, -y], [y, -x, w, -z], [x, y, z, w]])
    relative = quats @ conjugate_times.T
    relative[relative[:, 3] < 0] *= -1.0
    norm = np.linalg.norm(relative[:, :3], axis=1)
    small = norm < 1e-9
    factor = np.where(small, 2.0, 2.0 * np.arctan2(norm, relative[:, 3]) / np.where(small, 1.0, norm))
    return factor[:, None] * relative[:, :3]


def rotation_mean(quats: Float, weights: Float, start_quat: Float) -> Float:
    """Rotation of least weighted squared angles to the given ones, near the start: (n, 4), (n,), (4,) -> (4,).

    Each step goes to the mean of the tangent vectors. The squared angle curves nowhere more than its tangent parabola,
    so a step never increases the cost (Manton, ICARCV 2004, with unit step).
    """
    R = lie.matrix_from_quat(start_quat)
    total = weights.sum()
    for _ in range(_MEAN_MAX_STEPS):
        step = weights @ relative_rotvecs(quats, lie.quat_from_matrix(R)) / total
        R = R @ lie.so3_exp(step)
        if np.abs(step).max() < _MEAN_TOLERANCE_RAD:
            break
    return lie.quat_from_matrix(R)
