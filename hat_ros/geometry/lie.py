"""Rotations and rigid transforms: SO(3), SE(3), Sim(3) in numpy, batched over leading axes.

``T_a_b`` maps b-coordinates into a. Rotation vectors are radians. Quaternions are ``quat_xyzw`` (scalar last, as in
ROS). Between stages a pose travels as one *pose row* ``[x, y, z, qx, qy, qz, qw]``, so that a message and a value in
memory carry the same bits; matrices are always derived from rows by :func:`matrix_from_row`.

Formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", arXiv:1812.01537 (equation
numbers below); quaternion extraction after Shepperd, J. Guidance and Control 1 (1978).
"""

from __future__ import annotations

import math

import numpy as np

from hat_ros.array_types import Bool, Float

# Below this squared angle sin(x)/x and its relatives are taken from their series: the next term is under 1e-17.
_SMALL_ANGLE_SQ = 1e-8
# 1 - (x/2) cot(x/2) loses digits earlier; the next term of its series is under 1e-14 here.
_SMALL_ANGLE_SQ_JACOBIAN = 1e-5
_EYE = np.eye(3)


def hat(v: Float) -> Float:
    """Skew matrix ``[v]x``: (..., 3) -> (..., 3, 3)."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros(v.shape[:-1] + (3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def so3_exp(rotvec: Float) -> Float:
    """Rotation matrix of a rotation vector (eq. 132): (..., 3) -> (..., 3, 3)."""
    rotvec = np.asarray(rotvec, dtype=np.float64)
    if rotvec.ndim == 1:
        x, y, z = rotvec.tolist()
        return np.array(rotation_entries(x, y, z, _SMALL_ANGLE_SQ), dtype=np.float64).reshape(3, 3)
    angle_sq = np.sum(rotvec * rotvec, axis=-1)
    small = angle_sq < _SMALL_ANGLE_SQ
    safe = np.where(small, 1.0, angle_sq)
    angle = np.sqrt(safe)
    a = np.where(small, 1.0 - angle_sq / 6.0, np.sin(angle) / angle)
    b = np.where(small, 0.5 - angle_sq / 24.0, (1.0 - np.cos(angle)) / safe)
    k = hat(rotvec)
    return np.eye(3) + a[..., None, None] * k + b[..., None, None] * (k @ k)


def so3_log(R: Float) -> Float:
    """Rotation vector of a rotation matrix, angle in [0, pi]: (..., 3, 3) -> (..., 3).

    Goes through the quaternion, which stays well conditioned up to and at 180 degrees.
    """
    q = quat_from_matrix(R)
    if q.ndim == 1:
        x, y, z, w = q.tolist()
        norm = math.sqrt(x * x + y * y + z * z)
        return q[:3] * (2.0 if norm < 1e-9 else 2.0 * math.atan2(norm, w) / norm)
    norm = np.linalg.norm(q[..., :3], axis=-1)
    angle = 2.0 * np.arctan2(norm, q[..., 3])
    small = norm < 1e-9
    factor = np.where(small, 2.0, angle / np.where(small, 1.0, norm))
    return factor[..., None] * q[..., :3]


def so3_right_jacobian_inverse(rotvec: Float) -> Float:
    """J_r^-1 (eq. 144): Log(Exp(v) Exp(d)) = v + J_r^-1(v) d + O(d^2). (..., 3) -> (..., 3, 3)."""
    rotvec = np.asarray(rotvec, dtype=np.float64)
    k = hat(rotvec)
    if rotvec.ndim == 1:
        return _EYE + 0.5 * k + _curvature(float(rotvec @ rotvec)) * (k @ k)
    angle_sq = np.sum(rotvec * rotvec, axis=-1)
    small = angle_sq < _SMALL_ANGLE_SQ_JACOBIAN
    safe = np.where(small, 1.0, angle_sq)
    half = 0.5 * np.sqrt(safe)
    factor = np.where(small, 1.0 / 12.0 + angle_sq / 720.0, (1.0 - half / np.tan(half)) / safe)
    return _EYE + 0.5 * k + factor[..., None, None] * (k @ k)


def rotation_angle(R: Float) -> Float:
    """Smallest rotation angle in radians, in [0, pi]: (..., 3, 3) -> (...)."""
    q = quat_from_matrix(R)
    if q.ndim == 1:
        return 2.0 * np.arctan2(math.sqrt(q[:3] @ q[:3]), q[3])
    return 2.0 * np.arctan2(np.sqrt(np.einsum("...i,...i->...", q[..., :3], q[..., :3])), q[..., 3])


def angle_between(R_a: Float, R_b: Float) -> Float:
    """Angle in radians between two rotations: (..., 3, 3), (..., 3, 3) -> (...)."""
    return rotation_angle(np.asarray(R_a) @ np.swapaxes(np.asarray(R_b), -1, -2))


def quat_from_matrix(R: Float) -> Float:
    """Unit quaternion xyzw with qw >= 0 of a rotation matrix: (..., 3, 3) -> (..., 4)."""
    R = np.asarray(R, dtype=np.float64)
    if R.ndim == 2:
        return _quat_from_matrix_single(R)
    # Products of each component with all four, four times: the row of the largest keeps full precision everywhere.
    products = np.empty(R.shape[:-2] + (4, 4))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        products[..., i, i] = 1 + R[..., i, i] - R[..., j, j] - R[..., k, k]
        products[..., i, j] = products[..., j, i] = R[..., i, j] + R[..., j, i]
        products[..., k, 3] = products[..., 3, k] = R[..., j, i] - R[..., i, j]
    products[..., 3, 3] = 1 + R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    best = np.argmax(np.diagonal(products, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(products, best[..., None, None], axis=-2)[..., 0, :]
    q /= np.sqrt(np.einsum("...i,...i->...", q, q))[..., None]
    return np.where(q[..., 3:] < 0, -q, q)


def matrix_from_quat(quat_xyzw: Float) -> Float:
    """Rotation matrix of a quaternion, normalised here: (..., 4) -> (..., 3, 3)."""
    q = np.asarray(quat_xyzw, dtype=np.float64)
    if q.ndim == 1:
        return _matrix_from_quat_single(q)
    q = q / np.sqrt(np.einsum("...i,...i->...", q, q))[..., None]
    # Twice the products of all components.
    p = 2 * q[..., :, None] * q[..., None, :]
    R = np.empty(q.shape[:-1] + (3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        R[..., i, i] = 1 - (p[..., j, j] + p[..., k, k])
        R[..., i, j] = p[..., i, j] - p[..., k, 3]
        R[..., j, i] = p[..., i, j] + p[..., k, 3]
    return R


def transform(R: Float, t: Float) -> Float:
    """Rigid transform from its parts: (..., 3, 3), (..., 3) -> (..., 4, 4)."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    T = np.zeros(R.shape[:-2] + (4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def inverse(T: Float) -> Float:
    """Inverse of a rigid transform: (..., 4, 4) -> (..., 4, 4)."""
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R_t, -(R_t @ T[..., :3, 3:])[..., 0])


def row_from_matrix(T: Float) -> Float:
    """Pose row ``[x y z qx qy qz qw]``, qw >= 0: (..., 4, 4) -> (..., 7)."""
    T = np.asarray(T, dtype=np.float64)
    return np.concatenate([T[..., :3, 3], quat_from_matrix(T[..., :3, :3])], axis=-1)


def matrix_from_row(row: Float) -> Float:
    """Rigid transform of a pose row; NaN rows give NaN matrices: (..., 7) -> (..., 4, 4)."""
    row = np.asarray(row, dtype=np.float64)
    return transform(matrix_from_quat(row[..., 3:]), row[..., :3])


def is_rigid(T: Float, tolerance: float = 1e-4) -> Bool:
    """Whether each matrix is finite, has a proper rotation and the last row 0 0 0 1: (..., 4, 4) -> (...) bool."""
    T = np.asarray(T, dtype=np.float64)
    finite = np.asarray(np.isfinite(T).all(axis=(-1, -2)))
    safe = np.where(finite[..., None, None], T, np.eye(4))
    # No entry of a rotation exceeds 1; squares of larger ones could overflow.
    R = np.clip(safe[..., :3, :3], -2.0, 2.0)
    orthogonal = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(axis=(-1, -2)) < tolerance
    last = np.abs(safe[..., 3, :] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=-1) < tolerance
    return finite & orthogonal & last & (np.linalg.det(R) > 0)


# One pose at a time is what a stage handles per frame; there the batched functions above would spend all their time on
# numpy's overhead. Same formulas on plain floats, agreeing with the batched ones to the last bit or two.


def _curvature(angle_sq: float) -> float:
    """Factor of the squared skew matrix in J_r^-1."""
    if angle_sq < _SMALL_ANGLE_SQ_JACOBIAN:
        return 1.0 / 12.0 + angle_sq / 720.0
    half = 0.5 * math.sqrt(angle_sq)
    return (1.0 - half / math.tan(half)) / angle_sq


def rotation_entries(x: float, y: float, z: float, small_angle_sq: float) -> tuple[float, ...]:
    """The nine entries, row by row, of the rotation matrix of a rotation vector.

    Plain arithmetic: :mod:`hat_ros.geometry.linear` compiles this very function for the inner loops.

    Args:
        x, y, z: rotation vector, radians.
        small_angle_sq: squared angle below which the series is taken.
    """
    angle_sq = x * x + y * y + z * z
    if angle_sq < small_angle_sq:
        a, b = 1.0 - angle_sq / 6.0, 0.5 - angle_sq / 24.0
    else:
        angle = math.sqrt(angle_sq)
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle_sq
    return (
        1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y,
        b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x,
        b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y),
    )  # fmt: skip


def _quat_from_matrix_single(R: Float) -> Float:
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = R.tolist()
    squares = (1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22, 1 + m00 + m11 + m22)
    best = max(range(4), key=squares.__getitem__)
    x, y, z, w = (
        (squares[0], m01 + m10, m02 + m20, m21 - m12),
        (m01 + m10, squares[1], m12 + m21, m02 - m20),
        (m02 + m20, m12 + m21, squares[2], m10 - m01),
        (m21 - m12, m02 - m20, m10 - m01, squares[3]),
    )[best]
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if w < 0:
        norm = -norm
    return np.array([x / norm, y / norm, z / norm, w / norm])


def _matrix_from_quat_single(quat_xyzw: Float) -> Float:
    x, y, z, w = quat_xyzw.tolist()
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if norm == 0.0:
        return np.full((3, 3), np.nan)
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
