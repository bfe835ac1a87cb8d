"""Rotations and small dense linear algebra, compiled: plain loops and no BLAS, so the same bytes in every process."""

from __future__ import annotations

import numpy as np
from numba import njit

from hat_ros.array_types import Float
from hat_ros.geometry import lie

# The solvers' steps end far below a hundredth of a degree; where the series begins decides on the last bits of a pose.
_SMALL_ANGLE_SQ = 1e-12
_rotation_entries = njit(cache=True, nogil=True)(lie.rotation_entries)


@njit(cache=True, nogil=True)
def rotation(v: Float) -> Float:
    """Rotation matrix (3, 3) of a rotation vector (3,) in radians."""
    return np.array(_rotation_entries(v[0], v[1], v[2], _SMALL_ANGLE_SQ)).reshape(3, 3)


@njit(cache=True, nogil=True)
def product(A: Float, B: Float) -> Float:
    """Matrix product of two (3, 3)."""
    C = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return C


@njit(cache=True, nogil=True)
def turn_between(R_b: Float, R_a: Float) -> Float:
    """Rotation vector (3,) of ``R_b R_a^T``, for angles below 180 degrees."""
    D = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            D[i, j] = R_b[i, 0] * R_a[j, 0] + R_b[i, 1] * R_a[j, 1] + R_b[i, 2] * R_a[j, 2]
    v = np.empty(3)
    v[0], v[1], v[2] = 0.5 * (D[2, 1] - D[1, 2]), 0.5 * (D[0, 2] - D[2, 0]), 0.5 * (D[1, 0] - D[0, 1])
    sine = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if sine > 1e-9:
        v *= np.arctan2(sine, 0.5 * (D[0, 0] + D[1, 1] + D[2, 2] - 1.0)) / sine
    return v


@njit(cache=True, nogil=True)
def robust_mean_rotation(R: Float, cutoff_rad: float) -> Float:
    """Mean of (n, 3, 3) rotations that those further off than a few times ``cutoff_rad`` do not move.

    From the medoid, thrice reweighted (Geman-McClure).
    """
    mean, least = R[0], np.inf
    for i in range(len(R)):
        cost = 0.0
        for j in range(len(R)):
            # The squared chordal distance 3 - tr(A B^T) is the squared angle, for small ones.
            cost += min(3.0 - np.sum(R[i] * R[j]), (3.0 * cutoff_rad) ** 2)
        if cost < least:
            mean, least = R[i], cost
    for _ in range(3):
        turn, total = np.zeros(3), 0.0
        for i in range(len(R)):
            d = turn_between(R[i], mean)
            w = (1.0 + (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) / cutoff_rad**2) ** -2
            turn += w * d
            total += w
        mean = product(rotation(turn / total), mean)
    return mean


@njit(cache=True, nogil=True)
def cholesky_in_place(A: Float) -> bool:
    """Lower factor of a symmetric matrix, read from and written to its lower triangle; False if not definite."""
    for j in range(A.shape[0]):
        for i in range(j, A.shape[0]):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            if i > j:
                A[i, j] = s / A[j, j]
            elif s > 0.0:
                A[j, j] = np.sqrt(s)
            else:
                return False
    return True


@njit(cache=True, nogil=True)
def cholesky_solve(L: Float, b: Float) -> Float:
    """Solution of ``L L^T x = b``."""
    n = L.shape[0]
    x = b.copy()
    for i in range(n):
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
    return x


@njit(cache=True, nogil=True)
def factor_system(S: Float) -> bool:
    """Factor U of a symmetric matrix, S = U^T U, read from and written to the upper triangle; False if not definite.

    Row by row, so that the inner loop runs along memory and has no sum to carry: the compiler can use vectors.
    """
    n = S.shape[0]
    for j in range(n):
        if not S[j, j] > 0.0:
            return False
        S[j, j] = np.sqrt(S[j, j])
        pivot_row = S[j, j + 1 :]
        inverse = 1.0 / S[j, j]
        for k in range(len(pivot_row)):
            pivot_row[k] *= inverse
        for i in range(len(pivot_row)):
            f = pivot_row[i]
            source, row = pivot_row[i:], S[j + 1 + i, j + 1 + i :]
            for k in range(len(row)):
                row[k] -= f * source[k]
    return True


@njit(cache=True, nogil=True)
def solve_system(U: Float, b: Float) -> Float:
    """Solution of ``U^T U x = b``."""
    n = U.shape[0]
    x = b.copy()
    for i in range(n):
        x[i] /= U[i, i]
        f = x[i]
        rest, row = x[i + 1 :], U[i, i + 1 :]
        for k in range(len(row)):
            rest[k] -= f * row[k]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= U[i, k] * x[k]
        x[i] /= U[i, i]
    return x


@njit(cache=True, nogil=True)
def inverse_of_square(U: Float) -> Float:
    """Inverse of ``U^T U``."""
    n = U.shape[0]
    inverse = np.empty((n, n))
    for a in range(n):
        unit = np.zeros(n)
        unit[a] = 1.0
        inverse[a] = solve_system(U, unit)
    return inverse
