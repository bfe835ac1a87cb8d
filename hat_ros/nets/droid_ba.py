"""Dense bundle adjustment of DROID-SLAM: poses of keyframes and one inverse depth per pixel, batched in PyTorch.

Every edge (i, j) of the graph says where the pixels of frame i should appear in frame j. Depths are eliminated first
(Schur complement: each pixel's depth is independent of all others), the small system of poses is solved in float64,
then the depths follow (arXiv:2108.10869, section 3.2, "Dense Bundle Adjustment Layer"). Nothing loops over edges or
pixels and nothing waits for the device: all index arithmetic happens on the host, once per change of the graph.
Own code: the number of steps and their damping are part of the published method, and each pixel is an unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hat_ros.array_types import Int
from hat_ros.nets.droid_geometry import (
    pixel_rays,
    relative_poses,
    retract,
    rotation_matrix,
    transform_points,
)

Index = Int

_WEIGHT_SCALE = 1e-3
_SENSOR_WEIGHT = 0.05


@dataclass(frozen=True)
class BundleRule:
    """What the two published variants do differently.

    Attributes:
        min_depth: residuals of points nearer than this (scene units) do not count.
        eta_scale: factor on the network's depth damping.
        damp_before_schur: damp the pose blocks before depths are eliminated instead of after.
        skip_first_pose: depths do not react to the step of the first free pose.
        max_disparity: larger inverse depths are set to zero (before the floor applies).
        min_disparity: floor of the inverse depths.
    """

    min_depth: float = 0.25
    eta_scale: float = 0.2
    damp_before_schur: bool = False
    skip_first_pose: bool = False
    max_disparity: float = float("inf")
    min_disparity: float = 1e-3


# The released tracker, whose back-substitution leaves out the first free pose; its networks were used with that.
PUBLISHED_RULE = BundleRule(skip_first_pose=True)
EXACT_RULE = BundleRule()
# The layer that the networks were trained through.
TRAINING_RULE = BundleRule(min_depth=0.2, eta_scale=1.0, damp_before_schur=True, max_disparity=10.0, min_disparity=0.0)


class BundleLayout:
    """Where the blocks of each edge go; made on the host from the edge list.

    Args:
        ii: (E,) source frames.
        jj: (E,) target frames.
        first: first free pose.
        end: one past the last free pose; all other poses stay fixed.
        device: where the tensors live.
    """

    def __init__(self, ii: Index, jj: Index, first: int, end: int, device: torch.device | str) -> None:
        frames, frame_of_edge = np.unique(ii, return_inverse=True)
        self.first, self.end = first, end
        self.n_free = end - first
        # Fixed poses share one dummy index behind the free ones; what lands there is dropped.
        pose_i, pose_j = _free_index(ii, first, end), _free_index(jj, first, end)
        # Each frame's depths meet the poses of its own slot 0 and of one slot per edge that leaves it.
        order = np.argsort(frame_of_edge, kind="stable")
        start = np.searchsorted(frame_of_edge[order], np.arange(len(frames)))
        rank = np.empty(len(ii), dtype=np.int64)
        rank[order] = np.arange(len(ii)) - start[frame_of_edge[order]] + 1
        self.n_slots = int(rank.max()) + 1
        slot_pose = np.full((len(frames), self.n_slots), self.n_free)
        slot_pose[:, 0] = _free_index(frames, first, end)
        slot_pose[frame_of_edge, rank] = pose_j
        side = self.n_free + 1
        pair = slot_pose[:, :, None] * side + slot_pose[:, None, :]

        def send(array: Index) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).to(device, non_blocking=True)

        self.ii, self.jj, self.frames = send(ii), send(jj), send(frames)
        self.frame_of_edge = send(frame_of_edge)
        self.pose_of_edge = send(np.stack([pose_i, pose_j]))
        self.block_of_edge = send(
            np.stack([pose_i * side + pose_i, pose_i * side + pose_j, pose_j * side + pose_i, pose_j * side + pose_j])
        )
        self.slot_of_edge = send(frame_of_edge * self.n_slots + rank)
        self.slot_pose, self.slot_pair = send(slot_pose), send(pair)
        self.free = torch.arange(first, end, device=device)

    @property
    def n_frames(self) -> int:
        """Frames whose depths are free."""
        return len(self.frames)


def _free_index(frames: Index, first: int, end: int) -> Index:
    return np.where((frames >= first) & (frames < end), frames - first, end - first)


@dataclass(frozen=True)
class Damping:
    """Levenberg-Marquardt damping of the poses: ``relative`` of the diagonal plus ``absolute``."""

    relative: float = 1e-4
    absolute: float = 0.1


LOCAL_DAMPING = Damping()
GLOBAL_DAMPING = Damping(1e-5, 1e-2)


def bundle_adjust(
    poses: Tensor,
    disparities: Tensor,
    intrinsics: Tensor,
    target: Tensor,
    weight: Tensor,
    layout: BundleLayout,
    *,
    eta: Tensor | None = None,
    iterations: int = 2,
    damping: Damping = LOCAL_DAMPING,
    rule: BundleRule = PUBLISHED_RULE,
    motion_only: bool = False,
    sensed: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Gauss-Newton on the free poses and, unless ``motion_only``, on all inverse depths of the source frames.

    Args:
        poses: (n, 7) ``T_cam_world``.
        disparities: (n, h, w) inverse depths.
        intrinsics: (4,) in units of 8 pixels.
        target: (E, h, w, 2) wanted coordinates.
        weight: (E, h, w, 2) confidence, 0 to 1.
        layout: the edges and which poses are free.
        eta: (n_frames, h, w) damping of the depths in the order of ``layout.frames``; needed unless motion-only.
        iterations: Gauss-Newton steps.
        damping: of the poses.
        rule: variant.
        motion_only: keep the depths.
        sensed: (n, h, w) measured inverse depths, zero where there is none; takes the place of ``eta`` there.

    Returns:
        new poses and disparities; the arguments stay as they are.
    """
    if layout.n_free <= 0:
        return poses, disparities
    for _ in range(iterations):
        system = _linearise(poses, disparities, intrinsics, target, weight, layout, rule, motion_only)
        if motion_only:
            step = _solve(_damped(system.H, damping), system.b)
        elif eta is None:
            raise ValueError("bundle_adjust: depths are free, so their damping (eta) is needed")
        else:
            step, depth_step = _eliminate(system, layout, damping, rule, eta, disparities, sensed)
            disparities = _moved_disparities(disparities, depth_step, layout, rule)
        poses = poses.index_copy(0, layout.free, retract(poses[layout.free], step))
    return poses, disparities if motion_only else disparities.clamp_min(rule.min_disparity)


@dataclass(frozen=True)
class _System:
    """Normal equations; P free poses, K frames with D pose slots each, N = h w pixels."""

    H: Tensor  # (P, P, 6, 6)
    b: Tensor  # (P, 6)
    E: Tensor  # (K, D * 6, N) poses against depths
    C: Tensor  # (K, N) depths against themselves, a diagonal
    w: Tensor  # (K, N)


def _linearise(
    poses: Tensor,
    disparities: Tensor,
    intrinsics: Tensor,
    target: Tensor,
    weight: Tensor,
    layout: BundleLayout,
    rule: BundleRule,
    motion_only: bool,
) -> _System:
    n_edges = len(layout.ii)
    residual, confidence, J_i, J_j, J_z = _jacobians(poses, disparities, intrinsics, target, weight, layout, rule)
    J = torch.cat([J_i, J_j], dim=-1).flatten(1, 3)  # (E, 2N, 12), the two coordinates of a pixel side by side
    JW = J * confidence.flatten(1)[..., None]
    blocks = (J.transpose(1, 2) @ JW).view(n_edges, 2, 6, 2, 6).permute(1, 3, 0, 2, 4).flatten(0, 2)
    gradient = (JW.transpose(1, 2) @ residual.flatten(1)[..., None]).view(n_edges, 2, 6).transpose(0, 1)
    side = layout.n_free + 1
    H = poses.new_zeros(side * side, 6, 6).index_add_(0, layout.block_of_edge.flatten(), blocks)
    b = poses.new_zeros(side, 6).index_add_(0, layout.pose_of_edge.flatten(), gradient.flatten(0, 1))
    H = H.view(side, side, 6, 6)[: layout.n_free, : layout.n_free]
    b = b[: layout.n_free]
    if motion_only:
        empty = poses.new_zeros(0)
        return _System(H, b, empty, empty, empty)
    n_pixels = disparities.shape[-2] * disparities.shape[-1]
    weighted_z = confidence * J_z
    cross = (JW.view(n_edges, n_pixels, 2, 12) * J_z.view(n_edges, n_pixels, 2, 1)).sum(2).transpose(1, 2)
    slots = poses.new_zeros(layout.n_frames * layout.n_slots, 6, n_pixels)
    slots.index_add_(0, layout.slot_of_edge, cross[:, 6:])
    slots.index_add_(0, layout.frame_of_edge * layout.n_slots, cross[:, :6])
    sums = torch.stack([(weighted_z * J_z).sum(-1), (weighted_z * residual).sum(-1)]).flatten(2)
    C, w = poses.new_zeros(2, layout.n_frames, n_pixels).index_add_(1, layout.frame_of_edge, sums)
    return _System(H, b, slots.view(layout.n_frames, layout.n_slots * 6, n_pixels), C, w)


def _jacobians(
    poses: Tensor,
    disparities: Tensor,
    intrinsics: Tensor,
    target: Tensor,
    weight: Tensor,
    layout: BundleLayout,
    rule: BundleRule,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Residuals (E, h, w, 2), weights alike, derivatives by pose i and j (E, h, w, 2, 6) and by depth (E, h, w, 2)."""
    h, w = disparities.shape[-2:]
    relative = relative_poses(poses, layout.ii, layout.jj)
    d = disparities[layout.ii]
    points = transform_points(relative, pixel_rays(intrinsics, h, w), d)
    x, y, z = points.unbind(-1)
    counts = z >= rule.min_depth
    inv_z = torch.where(counts, 1.0 / torch.where(counts, z, torch.ones_like(z)), torch.zeros_like(z))
    u, v = x * inv_z, y * inv_z  # normalised image coordinates
    fx, fy, cx, cy = intrinsics.unbind()
    projected = torch.stack([fx * u + cx, fy * v + cy], dim=-1)
    confidence = _WEIGHT_SCALE * weight * counts[..., None]
    zero = torch.zeros_like(u)
    hd = d * inv_z
    J_j = torch.stack(
        [
            torch.stack([fx * hd, zero, -fx * u * hd, -fx * u * v, fx * (1 + u * u), -fx * v], dim=-1),
            torch.stack([zero, fy * hd, -fy * v * hd, -fy * (1 + v * v), fy * u * v, fy * u], dim=-1),
        ],
        dim=-2,
    )
    J_i = -J_j @ _adjoint(relative)[:, None, None]
    t = relative[:, None, None, :3]
    J_z = torch.stack([fx * inv_z * (t[..., 0] - t[..., 2] * u), fy * inv_z * (t[..., 1] - t[..., 2] * v)], dim=-1)
    return target - projected, confidence, J_i, J_j, J_z


def _adjoint(pose: Tensor) -> Tensor:
    """Adjoint ``[[R, [t]x R], [0, R]]``: (E, 7) -> (E, 6, 6)."""
    R = rotation_matrix(pose[:, 3:])
    t_cross_R = torch.linalg.cross(pose[:, :3, None].expand_as(R), R, dim=1)
    return torch.cat([torch.cat([R, t_cross_R], dim=2), torch.cat([torch.zeros_like(R), R], dim=2)], dim=1)


def _damped(H: Tensor, damping: Damping) -> Tensor:
    """(P, P, 6, 6) blocks -> (6P, 6P) float64 with the diagonal damped."""
    n = H.shape[0] * 6
    full = H.permute(0, 2, 1, 3).reshape(n, n).double()
    diagonal = full.diagonal()
    return full + torch.diag_embed(damping.absolute + damping.relative * diagonal)


def _solve(A: Tensor, b: Tensor) -> Tensor:
    """Cholesky solution of the poses (P, 6): zero if the matrix is not positive definite, NaN if it is not finite.

    NaN is let through, so that the caller notices; a step of zero would hide it for good.
    """
    factor, info = torch.linalg.cholesky_ex(A)
    step = torch.cholesky_solve(b.double().reshape(-1, 1), factor).view_as(b)
    step = torch.where(info == 0, step, torch.zeros_like(step))
    finite = A.isfinite().all() & b.isfinite().all()
    return torch.where(finite, step, torch.full_like(step, float("nan"))).to(b.dtype)


def _eliminate(
    system: _System,
    layout: BundleLayout,
    damping: Damping,
    rule: BundleRule,
    eta: Tensor,
    disparities: Tensor,
    sensed: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Schur complement, pose step (P, 6) and depth step (K, N)."""
    C, w = system.C, system.w
    regular = (rule.eta_scale * eta + 1e-7).flatten(1)
    if sensed is None:
        C = C + regular
    else:
        measured = sensed[layout.frames].flatten(1)
        known = measured > 0
        C = C + torch.where(known, torch.full_like(C, _SENSOR_WEIGHT), regular)
        w = w - torch.where(known, _SENSOR_WEIGHT * (disparities[layout.frames].flatten(1) - measured), 0.0)
    Q = 1.0 / C
    EQ = system.E * Q[:, None]
    K, D, side = layout.n_frames, layout.n_slots, layout.n_free + 1
    blocks = (EQ @ system.E.transpose(1, 2)).view(K, D, 6, D, 6).transpose(2, 3).reshape(K * D * D, 6, 6)
    gradient = (EQ @ w[..., None]).view(K * D, 6)
    S = blocks.new_zeros(side * side, 6, 6).index_add_(0, layout.slot_pair.flatten(), blocks)
    g = blocks.new_zeros(side, 6).index_add_(0, layout.slot_pose.flatten(), gradient)
    S = S.view(side, side, 6, 6)[: layout.n_free, : layout.n_free]
    if rule.damp_before_schur:
        A = _damped(system.H, damping) - S.permute(0, 2, 1, 3).reshape(6 * layout.n_free, -1).double()
    else:
        A = _damped(system.H - S, damping)
    step = _solve(A, system.b - g[: layout.n_free])
    seen = torch.cat([step, step.new_zeros(1, 6)])
    if rule.skip_first_pose:
        seen = torch.cat([torch.zeros_like(seen[:1]), seen[1:]])
    reaction = (seen[layout.slot_pose].view(K, 1, D * 6) @ system.E)[:, 0]
    return step, Q * (w - reaction)


def _moved_disparities(disparities: Tensor, step: Tensor, layout: BundleLayout, rule: BundleRule) -> Tensor:
    moved = disparities.index_add(0, layout.frames, step.view(layout.n_frames, *disparities.shape[-2:]))
    if rule.max_disparity < float("inf"):
        moved = torch.where(moved > rule.max_disparity, torch.zeros_like(moved), moved)
    return moved
