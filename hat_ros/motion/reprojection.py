"""One observation of one point: its residual, derivatives and robust loss; and the pose of a frame from known points.

Poses are updated from the left, ``R <- Exp(d) R`` and ``t <- t + tau``: the origin of the SLAM frame lies in the
target, so turning and moving stay decoupled. Compiled, as part of every frame: a pose from 200 points takes 0.1 ms,
5 ms with ``scipy.optimize.least_squares``.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hat_ros.array_types import Bool, Float
from hat_ros.geometry.linear import cholesky_in_place, cholesky_solve, product, rotation, turn_between

# Nearer than this share of the unit (the target's distance at the start) a point counts as behind the camera.
MIN_DEPTH = 1e-3


@njit(cache=True, nogil=True)
def observe(R: Float, t: Float, X: Float, xn: Float, focal: float, r: Float, J_pose: Float, J_point: Float) -> bool:
    """Residual (2,) px and its Jacobians (2, 6), (2, 3); False when the point is behind the camera."""
    rx = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2]
    ry = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2]
    rz = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2]
    z = rz + t[2]
    if z < MIN_DEPTH:
        return False
    u, v, f = (rx + t[0]) / z, (ry + t[1]) / z, focal / z
    r[0], r[1] = focal * (u - xn[0]), focal * (v - xn[1])
    # d(u, v)/d(p_cam) = f [1 0 -u; 0 1 -v]; d(p_cam)/d(rotation) = -[R X]x.
    J_pose[0, 0], J_pose[0, 1], J_pose[0, 2] = -f * u * ry, f * (rz + u * rx), -f * ry
    J_pose[1, 0], J_pose[1, 1], J_pose[1, 2] = -f * (rz + v * ry), f * v * rx, f * rx
    J_pose[0, 3], J_pose[0, 4], J_pose[0, 5] = f, 0.0, -f * u
    J_pose[1, 3], J_pose[1, 4], J_pose[1, 5] = 0.0, f, -f * v
    for j in range(3):
        J_point[0, j] = f * (R[0, j] - u * R[2, j])
        J_point[1, j] = f * (R[1, j] - v * R[2, j])
    return True


@njit(cache=True, nogil=True)
def loss(error_sq: float, cutoff_sq: float) -> float:
    """Geman-McClure: the square near zero, ``cutoff_sq`` far away."""
    return cutoff_sq * error_sq / (cutoff_sq + error_sq)


@njit(cache=True, nogil=True)
def weight(error_sq: float, cutoff_sq: float) -> float:
    """Weight of the square that has the same gradient as :func:`loss`."""
    q = cutoff_sq / (cutoff_sq + error_sq)
    return q * q


@njit(cache=True, nogil=True)
def refine_pose(
    R: Float, t: Float, X: Float, xn: Float, use: Bool, focal: float, sigma_px: float, cutoff_px: float,
    R_expected: Float, t_expected: Float, turn_info: float, move_info: float, n_iterations: int,
) -> tuple[Float, Float, Float]:  # fmt: skip
    """Pose of one frame from known points, pulled towards an expected pose; Gauss-Newton.

    Args:
        R, t: (3, 3), (3,) start.
        X: (N, 3) points; xn: (N, 2) normalised observations; use: (N,) which of them count.
        focal, sigma_px, cutoff_px: as in :class:`hat_ros.motion.bundle.Problem`.
        R_expected, t_expected: expected pose; turn_info (1/rad^2), move_info (1/unit^2) its information.
        n_iterations: steps.

    Returns:
        R (3, 3), t (3,), and the residual norms (N,) in pixels, infinite where there is none.
    """
    R, t = R.copy(), t.copy()
    residual = np.full(len(X), np.inf)
    H, b = np.empty((6, 6)), np.empty(6)
    r, J, J_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    for iteration in range(n_iterations + 1):
        H[:], b[:], residual[:] = 0.0, 0.0, np.inf
        for i in range(len(X)):
            if not use[i] or not observe(R, t, X[i], xn[i], focal, r, J, J_point):
                continue
            error_sq = r[0] * r[0] + r[1] * r[1]
            residual[i] = np.sqrt(error_sq)
            w = weight(error_sq, cutoff_px * cutoff_px) / (sigma_px * sigma_px)
            for a in range(6):
                b[a] -= w * (J[0, a] * r[0] + J[1, a] * r[1])
                for c in range(a + 1):
                    H[a, c] += w * (J[0, a] * J[0, c] + J[1, a] * J[1, c])
        if iteration == n_iterations:
            break
        turn = turn_between(R, R_expected)
        for a in range(3):
            H[a, a] += turn_info
            H[a + 3, a + 3] += move_info
            b[a] -= turn_info * turn[a]
            b[a + 3] -= move_info * (t[a] - t_expected[a])
        if not cholesky_in_place(H):
            break
        d = cholesky_solve(H, b)
        R = product(rotation(d[:3]), R)
        t += d[3:]
    return R, t, residual
