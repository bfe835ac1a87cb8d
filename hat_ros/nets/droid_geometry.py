"""Rigid motions and reprojection for DROID-SLAM, batched in PyTorch.

A pose is one row ``[tx ty tz qx qy qz qw]`` that maps world points into the camera (``T_cam_world``), a tangent is
``[translation(3), rotation(3)]`` and acts from the left, ``T <- Exp(xi) T``. Depth is kept as inverse depth
("disparity") d at 1/8 resolution, so a pixel is the homogeneous point ``[(u-cx)/fx, (v-cy)/fy, 1, d]``.
Intrinsics are rows ``[fx fy cx cy]`` in units of 8 pixels.

Formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", arXiv:1812.01537; reprojection
and frame distance as in DROID-SLAM (arXiv:2108.10869). :mod:`hat_ros.geometry.lie` has the same maps in numpy; these
run on torch's devices and in float32, whose series begin elsewhere.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Below this squared angle the coefficients of the exponential come from their series (float32: next term < 1e-8).
_SMALL_ANGLE_SQ = 1e-4
# Nearer points (scene units) are projected as if at depth one; nearer than the second, they do not count.
_DIVIDE_DEPTH = 0.1
_TRUST_DEPTH = 0.2
_DISTANCE_MIN_DEPTH = 0.25
_DISTANCE_MIN_SHARE = 0.75
UNRELATED_DISTANCE = 1000.0


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product of quaternions xyzw: (..., 4), (..., 4) -> (..., 4)."""
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    vector = aw * bv + bw * av + torch.linalg.cross(av, bv)
    return torch.cat([vector, aw * bw - (av * bv).sum(-1, keepdim=True)], dim=-1)


def rotate(quat: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors: (..., 4), (..., 3) -> (..., 3)."""
    axis, w = quat[..., :3], quat[..., 3:]
    twice = 2.0 * torch.linalg.cross(axis, v)
    return v + w * twice + torch.linalg.cross(axis, twice)


def compose(a: Tensor, b: Tensor) -> Tensor:
    """Product of poses: (..., 7), (..., 7) -> (..., 7)."""
    return torch.cat([rotate(a[..., 3:], b[..., :3]) + a[..., :3], quat_multiply(a[..., 3:], b[..., 3:])], dim=-1)


def invert(pose: Tensor) -> Tensor:
    """Inverse pose: (..., 7) -> (..., 7)."""
    conjugate = torch.cat([-pose[..., 3:6], pose[..., 6:]], dim=-1)
    return torch.cat([-rotate(conjugate, pose[..., :3]), conjugate], dim=-1)


def rotation_matrix(quat: Tensor) -> Tensor:
    """Matrix of a unit quaternion xyzw: (..., 4) -> (..., 3, 3)."""
    axes = torch.eye(3, dtype=quat.dtype, device=quat.device).expand(*quat.shape[:-1], 3, 3)
    return rotate(quat[..., None, :].expand(*quat.shape[:-1], 3, 4), axes).transpose(-1, -2)


def _angle_coefficients(angle_sq: Tensor) -> tuple[Tensor, Tensor]:
    """(1 - cos a) / a^2 and (a - sin a) / a^3."""
    small = angle_sq < _SMALL_ANGLE_SQ
    safe = torch.where(small, torch.ones_like(angle_sq), angle_sq)
    angle = safe.sqrt()
    b = torch.where(small, 0.5 - angle_sq / 24.0, (1 - angle.cos()) / safe)
    c = torch.where(small, 1.0 / 6.0 - angle_sq / 120.0, (angle - angle.sin()) / (safe * angle))
    return b, c


def exp(xi: Tensor) -> Tensor:
    """Pose of a tangent (eqs. 172, 145): (..., 6) -> (..., 7)."""
    tau, phi = xi[..., :3], xi[..., 3:]
    angle_sq = (phi * phi).sum(-1, keepdim=True)
    b, c = _angle_coefficients(angle_sq)
    once = torch.linalg.cross(phi, tau)
    translation = tau + b * once + c * torch.linalg.cross(phi, once)
    small = angle_sq < _SMALL_ANGLE_SQ
    half = 0.5 * torch.where(small, torch.ones_like(angle_sq), angle_sq).sqrt()
    sinc = torch.where(small, 0.5 - angle_sq / 48.0, half.sin() / (2.0 * half))
    cos = torch.where(small, 1.0 - angle_sq / 8.0, half.cos())
    return torch.cat([translation, sinc * phi, cos], dim=-1)


def log(pose: Tensor) -> Tensor:
    """Tangent of a pose, rotation angle in [0, pi] (eqs. 173, 146): (..., 7) -> (..., 6)."""
    quat = torch.where(pose[..., 6:] < 0, -pose[..., 3:], pose[..., 3:])
    vector = quat[..., :3]
    norm = vector.norm(dim=-1, keepdim=True)
    small = norm < 1e-6
    angle = 2.0 * torch.atan2(norm, quat[..., 3:])
    phi = vector * torch.where(small, torch.full_like(norm, 2.0), angle / torch.where(small, 1.0, norm))
    angle_sq = (phi * phi).sum(-1, keepdim=True)
    b, c = _angle_coefficients(angle_sq)
    # V^-1 = I - [phi]x / 2 + k [phi]x^2; k cancels badly in float32 below 0.1 rad, its series does not.
    small = angle_sq < 1e-2
    k = (2.0 * b - 1.0 + angle_sq * c) / (2.0 * b * torch.where(small, torch.ones_like(angle_sq), angle_sq))
    k = torch.where(small, 1.0 / 12.0 + angle_sq / 720.0, k)
    once = torch.linalg.cross(phi, pose[..., :3])
    tau = pose[..., :3] - 0.5 * once + k * torch.linalg.cross(phi, once)
    return torch.cat([tau, phi], dim=-1)


def retract(pose: Tensor, xi: Tensor) -> Tensor:
    """``Exp(xi) T`` with the quaternion normalised again: (..., 7), (..., 6) -> (..., 7)."""
    moved = compose(exp(xi), pose)
    return torch.cat([moved[..., :3], torch.nn.functional.normalize(moved[..., 3:], dim=-1)], dim=-1)


def pixel_grid(h: int, w: int, device: torch.device | str | None = None) -> Tensor:
    """Integer pixel coordinates (x, y): -> (h, w, 2) float32."""
    y, x = torch.meshgrid(torch.arange(h, device=device), torch.arange(w, device=device), indexing="ij")
    return torch.stack([x, y], dim=-1).float()


def pixel_rays(intrinsics: Tensor, h: int, w: int) -> Tensor:
    """Rays at depth one: (4,) -> (h, w, 3)."""
    xy = (pixel_grid(h, w, intrinsics.device) - intrinsics[2:]) / intrinsics[:2]
    return torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1)


def relative_poses(poses: Tensor, ii: Tensor, jj: Tensor) -> Tensor:
    """``T_j T_i^-1`` of each edge: (n, 7), (E,), (E,) -> (E, 7)."""
    return compose(poses[jj], invert(poses[ii]))


def transform_points(relative: Tensor, rays: Tensor, disparity: Tensor) -> Tensor:
    """Homogeneous pixels moved into frame j, scaled by inverse depth: (E, 7), (h, w, 3), (E, h, w) -> (E, h, w, 3)."""
    rotated = torch.einsum("eab,hwb->ehwa", rotation_matrix(relative[:, 3:]), rays)
    return rotated + relative[:, None, None, :3] * disparity[..., None]


def project(points: Tensor, intrinsics: Tensor) -> Tensor:
    """Coordinates of points (..., 3); those about behind the camera as if at depth one -> (..., 2)."""
    z = points[..., 2:]
    z = torch.where(z < _DIVIDE_DEPTH, torch.ones_like(z), z)
    return intrinsics[:2] * (points[..., :2] / z) + intrinsics[2:]


def reproject(
    poses: Tensor,
    disparities: Tensor,
    intrinsics: Tensor,
    ii: Tensor,
    jj: Tensor,
) -> tuple[Tensor, Tensor]:
    """Where the pixels of frame i appear in frame j.

    Args:
        poses: (n, 7) ``T_cam_world``.
        disparities: (n, h, w).
        intrinsics: (4,).
        ii: (E,) source frames.
        jj: (E,) target frames.

    Returns:
        coordinates (E, h, w, 2) and whether they count (E, h, w) bool.
    """
    rays = pixel_rays(intrinsics, *disparities.shape[-2:])
    points = transform_points(relative_poses(poses, ii, jj), rays, disparities[ii])
    return project(points, intrinsics), points[..., 2] > _TRUST_DEPTH


def frame_distance(
    poses: Tensor, disparities: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, beta: float
) -> Tensor:
    """Mean flow that the current geometry induces between frames, both directions averaged.

    ``beta`` weighs the flow of the full motion, ``1 - beta`` that of the translation alone. Pairs of which less than
    three quarters of the pixels stay in front of the camera are :data:`UNRELATED_DISTANCE` apart.

    Args:
        poses: (n, 7) ``T_cam_world``.
        disparities: (n, h, w).
        intrinsics: (4,).
        ii: (E,) first frames.
        jj: (E,) second frames.
        beta: 0 to 1.

    Returns:
        (E,) distances in units of 8 pixels.
    """
    forward = _one_way_distance(poses, disparities, intrinsics, ii, jj, beta)
    return 0.5 * (forward + _one_way_distance(poses, disparities, intrinsics, jj, ii, beta))


def _one_way_distance(
    poses: Tensor, disparities: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, beta: float
) -> Tensor:
    h, w = disparities.shape[-2:]
    rays, grid = pixel_rays(intrinsics, h, w), pixel_grid(h, w, intrinsics.device)
    relative, disparity = relative_poses(poses, ii, jj), disparities[ii]
    full = transform_points(relative, rays, disparity)
    translated = rays + relative[:, None, None, :3] * disparity[..., None]
    total = disparity.new_zeros(len(ii))
    share = disparity.new_zeros(len(ii))
    for points, factor in ((full, beta), (translated, 1.0 - beta)):
        counts = points[..., 2] > _DISTANCE_MIN_DEPTH
        z = torch.where(counts, points[..., 2], torch.ones_like(points[..., 2]))
        flow = intrinsics[:2] * (points[..., :2] / z[..., None]) + intrinsics[2:] - grid
        total = total + factor * (flow.norm(dim=-1) * counts).sum((-1, -2))
        share = share + factor * counts.sum((-1, -2))
    share = share / (h * w)
    mean = total / (h * w) / share.clamp_min(1e-6)
    return torch.where(share < _DISTANCE_MIN_SHARE, torch.full_like(mean, UNRELATED_DISTANCE), mean)
