"""Windowed bundle adjustment: the poses of a few frames and the points they track, by the Schur complement.

A window has W camera poses ``p_cam = R_k p_slam + t_k`` and N points ``p_slam``; observations are normalised image
coordinates (x/z, y/z). The cost is the sum of

* Geman-McClure reprojection errors in pixels: redescending, because moving highlights and shadow edges are consistent
  outliers that a convex loss would average in,
* the same loss on each point's distance from where the CAD surface or its neighbours put it,
* the same loss on each pose's rotation from the one that fused poses of the past suggest,
* squared changes of the angular and linear rate between consecutive frames of the window (constant-rate prior),
* a weak square that holds the oldest frame and so fixes the gauge.

Levenberg-Marquardt on iteratively reweighted normal equations, points eliminated first (Triggs et al., "Bundle
adjustment - a modern synthesis", 2000, section 6.1). Plain compiled loops, no BLAS: the same bytes in every process.
Three steps on 10 frames and 200 points take 1.4 ms, 43 ms with the sparse ``scipy.optimize.least_squares``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hat_ros.array_types import Bool, Float
from hat_ros.geometry.linear import (
    cholesky_in_place,
    cholesky_solve,
    factor_system,
    inverse_of_square,
    product,
    rotation,
    solve_system,
    turn_between,
)
from hat_ros.motion.reprojection import MIN_DEPTH, loss, observe, weight

# Squared scales, in sigmas, of the losses on expected points and rotations; rotations all share their gauge, so that a
# drift across the window may set the outer ones far apart.
_POINT_CUTOFF_SQ = 9.0
_TURN_CUTOFF_SQ = 100.0
_FIRST_DAMPING = 1e-4


class Problem(NamedTuple):
    """What a window knows besides its state.

    Attributes:
        xn: (W, N, 2) normalised observations; seen: (W, N) which of them exist.
        focal: pixels per unit of normalised coordinates.
        sigma_px: standard deviation of an observation; cutoff_px: scale of its loss.
        X_expected: (N, 3) expected points; X_info: (N,) their information (1/unit^2), 0 = none.
        R_expected: (W, 3, 3) expected rotations; R_info: (W,) their information (1/rad^2), 0 = none.
        dt: (W,) seconds since the previous frame of the window, first entry unused.
        rate_info: (W, 2) information of the change of angular and linear rate about each frame, ends unused.
        R_gauge: (3, 3), t_gauge: (3,) where the oldest frame is held; gauge_info: how firmly.
    """

    xn: Float
    seen: Bool
    focal: float
    sigma_px: float
    cutoff_px: float
    X_expected: Float
    X_info: Float
    R_expected: Float
    R_info: Float
    dt: Float
    rate_info: Float
    R_gauge: Float
    t_gauge: Float
    gauge_info: float


@njit(cache=True, nogil=True)
def window_cost(R: Float, t: Float, X: Float, p: Problem) -> float:
    """Value of the cost (module text) at a state (W, 3, 3), (W, 3), (N, 3)."""
    W, N = p.seen.shape
    cutoff_sq = (p.cutoff_px / p.sigma_px) ** 2
    scale = p.focal / p.sigma_px
    cost = 0.0
    for k in range(W):
        for i in range(N):
            if not p.seen[k, i]:
                continue
            x = R[k, 0, 0] * X[i, 0] + R[k, 0, 1] * X[i, 1] + R[k, 0, 2] * X[i, 2] + t[k, 0]
            y = R[k, 1, 0] * X[i, 0] + R[k, 1, 1] * X[i, 1] + R[k, 1, 2] * X[i, 2] + t[k, 1]
            z = R[k, 2, 0] * X[i, 0] + R[k, 2, 1] * X[i, 1] + R[k, 2, 2] * X[i, 2] + t[k, 2]
            if z < MIN_DEPTH:
                cost += cutoff_sq
                continue
            u, v = scale * (x / z - p.xn[k, i, 0]), scale * (y / z - p.xn[k, i, 1])
            cost += loss(u * u + v * v, cutoff_sq)
    for i in range(N):
        if p.X_info[i] > 0.0:
            d = X[i] - p.X_expected[i]
            cost += loss(p.X_info[i] * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), _POINT_CUTOFF_SQ)
    for k in range(W):
        if p.R_info[k] > 0.0:
            d = turn_between(R[k], p.R_expected[k])
            cost += loss(p.R_info[k] * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), _TURN_CUTOFF_SQ)
    for k in range(1, W - 1):
        before, after = turn_between(R[k], R[k - 1]), turn_between(R[k + 1], R[k])
        for a in range(3):
            cost += p.rate_info[k, 0] * (after[a] / p.dt[k + 1] - before[a] / p.dt[k]) ** 2
            change = (t[k + 1, a] - t[k, a]) / p.dt[k + 1] - (t[k, a] - t[k - 1, a]) / p.dt[k]
            cost += p.rate_info[k, 1] * change**2
    d = turn_between(R[0], p.R_gauge)
    for a in range(3):
        cost += p.gauge_info * (d[a] * d[a] + (t[0, a] - p.t_gauge[a]) ** 2)
    return cost


@njit(cache=True, nogil=True)
def _add_rate_terms(S: Float, g: Float, R: Float, t: Float, p: Problem) -> None:
    """Constant-rate prior: adds to the upper triangle of S (6W, 6W) and to the descent direction g (6W,)."""
    J = np.empty((3, 3, 3))
    c = np.empty(3)
    for k in range(1, len(R) - 1):
        before, after = turn_between(R[k], R[k - 1]), turn_between(R[k + 1], R[k])
        A, B = product(R[k], R[k - 1].T), product(R[k + 1], R[k].T)
        i1, i2 = 1.0 / p.dt[k], 1.0 / p.dt[k + 1]
        for a in range(3):
            for b in range(3):
                unit = 1.0 if a == b else 0.0
                J[0, a, b], J[1, a, b], J[2, a, b] = i1 * A[a, b], -i2 * B[a, b] - i1 * unit, i2 * unit
        c[0], c[1], c[2] = i1, -i1 - i2, i2
        w_turn, w_move = p.rate_info[k, 0], p.rate_info[k, 1]
        for f in range(3):
            row = 6 * (k - 1 + f)
            for b in range(3):
                for a in range(3):
                    g[row + b] -= w_turn * J[f, a, b] * (after[a] * i2 - before[a] * i1)
                g[row + 3 + b] -= w_move * c[f] * ((t[k + 1, b] - t[k, b]) * i2 - (t[k, b] - t[k - 1, b]) * i1)
            for h in range(f, 3):
                col = 6 * (k - 1 + h)
                for b in range(3):
                    S[row + 3 + b, col + 3 + b] += w_move * c[f] * c[h]
                    for d in range(3):
                        s = J[f, 0, b] * J[h, 0, d] + J[f, 1, b] * J[h, 1, d] + J[f, 2, b] * J[h, 2, d]
                        S[row + b, col + d] += w_turn * s


@njit(cache=True, nogil=True)
def _add_pose_terms(S: Float, g: Float, R: Float, t: Float, p: Problem) -> None:
    """Expected rotations and the gauge."""
    for k in range(len(R)):
        if p.R_info[k] > 0.0:
            d = turn_between(R[k], p.R_expected[k])
            w = p.R_info[k]
            w *= weight(w * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), _TURN_CUTOFF_SQ)
            for a in range(3):
                S[6 * k + a, 6 * k + a] += w
                g[6 * k + a] -= w * d[a]
    d = turn_between(R[0], p.R_gauge)
    for a in range(3):
        S[a, a] += p.gauge_info
        S[a + 3, a + 3] += p.gauge_info
        g[a] -= p.gauge_info * d[a]
        g[a + 3] -= p.gauge_info * (t[0, a] - p.t_gauge[a])


@njit(cache=True, nogil=True)
def _add_observations(
    i: int, S: Float, g: Float, V: Float, b: Float, C: Float, R: Float, t: Float, X: Float, p: Problem,
    r: Float, J: Float, J_point: Float,
) -> bool:  # fmt: skip
    """Terms of point i: poses into S and g, the point into V (3, 3) and b (3,), the mixed block into C (W, 6, 3).

    Returns False when nothing sees the point. The last three arguments are scratch space.
    """
    V[:], b[:], C[:] = 0.0, 0.0, 0.0
    any_seen = False
    for k in range(len(R)):
        if not p.seen[k, i] or not observe(R[k], t[k], X[i], p.xn[k, i], p.focal, r, J, J_point):
            continue
        any_seen = True
        w = weight(r[0] * r[0] + r[1] * r[1], p.cutoff_px * p.cutoff_px) / (p.sigma_px * p.sigma_px)
        o = 6 * k
        for a in range(6):
            w0, w1 = w * J[0, a], w * J[1, a]
            g[o + a] -= w0 * r[0] + w1 * r[1]
            for c in range(a, 6):
                S[o + a, o + c] += w0 * J[0, c] + w1 * J[1, c]
            for c in range(3):
                C[k, a, c] = w0 * J_point[0, c] + w1 * J_point[1, c]
        for a in range(3):
            w0, w1 = w * J_point[0, a], w * J_point[1, a]
            b[a] -= w0 * r[0] + w1 * r[1]
            for c in range(a + 1):
                V[a, c] += w0 * J_point[0, c] + w1 * J_point[1, c]
    if p.X_info[i] > 0.0:
        d = X[i] - p.X_expected[i]
        w = p.X_info[i]
        w *= weight(w * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), _POINT_CUTOFF_SQ)
        for a in range(3):
            V[a, a] += w
            b[a] -= w * d[a]
    return any_seen


@njit(cache=True, nogil=True)
def _eliminate(i: int, S: Float, g: Float, L: Float, b: Float, C: Float, Y: Float, p: Problem) -> None:
    """Schur complement of point i, its block already factored as L L^T: S -= Y^T Y, g -= Y^T L^-1 b, Y = L^-1 C^T."""
    y0 = b[0] / L[0, 0]
    y1 = (b[1] - L[1, 0] * y0) / L[1, 1]
    y2 = (b[2] - L[2, 0] * y0 - L[2, 1] * y1) / L[2, 2]
    W = len(C)
    for k in range(W):
        for a in range(6):
            v0 = C[k, a, 0] / L[0, 0]
            v1 = (C[k, a, 1] - L[1, 0] * v0) / L[1, 1]
            v2 = (C[k, a, 2] - L[2, 0] * v0 - L[2, 1] * v1) / L[2, 2]
            Y[0, 6 * k + a], Y[1, 6 * k + a], Y[2, 6 * k + a] = v0, v1, v2
            g[6 * k + a] -= v0 * y0 + v1 * y1 + v2 * y2
    for k in range(W):
        if not p.seen[k, i]:
            continue
        # Views that begin at the diagonal block: indices that start at zero are what the compiler can vectorise.
        Y0, Y1, Y2 = Y[0, 6 * k :], Y[1, 6 * k :], Y[2, 6 * k :]
        for a in range(6):
            row = S[6 * k + a, 6 * k :]
            v0, v1, v2 = Y0[a], Y1[a], Y2[a]
            for c in range(len(row)):
                row[c] -= v0 * Y0[c] + v1 * Y1[c] + v2 * Y2[c]


@njit(cache=True, nogil=True)
def _step_points(X: Float, step: Float, V: Float, b: Float, C: Float, solved: Bool, p: Problem) -> Float:
    """Points after a step (6W,) of the poses: back-substitution."""
    X_new = X.copy()
    for i in range(len(X)):
        if not solved[i]:
            continue
        v = b[i].copy()
        for k in range(p.seen.shape[0]):
            if p.seen[k, i]:
                for a in range(6):
                    for c in range(3):
                        v[c] -= C[i, k, a, c] * step[6 * k + a]
        X_new[i] += cholesky_solve(V[i], v)
    return X_new


@njit(cache=True, nogil=True)
def adjust_window(R: Float, t: Float, X: Float, p: Problem, n_iterations: int) -> tuple[float, Float]:
    """Minimise the cost in place.

    Args:
        R, t: (W, 3, 3), (W, 3) poses, oldest first, W >= 2.
        X: (N, 3) points; those that no frame sees stay where they are.
        p: the rest of the problem.
        n_iterations: steps tried.

    Returns:
        The cost reached, and the covariance (12, 12) of rotation and position of the last two frames; infinite when
        no step succeeded.
    """
    W, N = p.seen.shape
    n = 6 * W
    S, g, Y = np.empty((n, n)), np.empty(n), np.empty((3, n))
    V, b, C = np.empty((N, 3, 3)), np.empty((N, 3)), np.empty((N, W, 6, 3))
    solved = np.empty(N, np.bool_)
    r, J, J_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    R_new, t_new = np.empty_like(R), np.empty_like(t)
    covariance = np.full((12, 12), np.inf)
    damping = _FIRST_DAMPING
    cost = window_cost(R, t, X, p)
    for _ in range(n_iterations):
        S[:], g[:] = 0.0, 0.0
        for i in range(N):
            solved[i] = False
            if not _add_observations(i, S, g, V[i], b[i], C[i], R, t, X, p, r, J, J_point):
                continue
            ridge = 1e-9 * (V[i, 0, 0] + V[i, 1, 1] + V[i, 2, 2])
            for a in range(3):
                V[i, a, a] += damping * V[i, a, a] + ridge
            solved[i] = cholesky_in_place(V[i])
            if solved[i]:
                _eliminate(i, S, g, V[i], b[i], C[i], Y, p)
        _add_rate_terms(S, g, R, t, p)
        _add_pose_terms(S, g, R, t, p)
        for a in range(n):
            S[a, a] += damping * S[a, a] + 1e-9
        if not factor_system(S):
            damping *= 100.0
            continue
        step = solve_system(S, g)
        for k in range(W):
            R_new[k] = product(rotation(step[6 * k : 6 * k + 3]), R[k])
            t_new[k] = t[k] + step[6 * k + 3 : 6 * k + 6]
        X_new = _step_points(X, step, V, b, C, solved, p)
        new_cost = window_cost(R_new, t_new, X_new, p)
        if not new_cost <= cost:
            damping *= 10.0
            continue
        R[:], t[:], X[:] = R_new, t_new, X_new
        # The last block of the inverse needs only the last block of the factor.
        covariance = inverse_of_square(S[n - 12 :, n - 12 :])
        damping = max(0.2 * damping, 1e-6)
        gain, cost = cost - new_cost, new_cost
        if gain < 1e-4 * cost:
            break
    return cost, covariance
