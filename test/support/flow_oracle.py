"""A clip of known geometry and a stand-in for DROID's network that answers with the clip's true flow.

The stand-in implements the front end's ``FlowModel``: its "features" of a frame are the target-frame coordinates of
every pixel, their depth and the frame's pose, so the true flow between any two frames follows from their features.
"""

from dataclasses import dataclass

import numpy as np
import torch
import trimesh

from hat_ros.config import DroidConfig, HatConfig, SlamConfig
from hat_ros.geometry import lie
from hat_ros.target.loading import target_from_scene
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.types import Camera, Detection, Frame

STRIDE = 8
# A clip that one core tracks in a few seconds.
SMALL = {"width": 160, "height": 128, "focal": 190.0, "step_deg": 3.0, "range_m": 4.5}


def satellite():
    """A body with two panels, a dish and a boom: depth steps, curvature and flat parts."""
    body = trimesh.creation.box((1.6, 1.4, 1.8))
    panels = [
        trimesh.creation.box((2.2, 0.06, 1.1), transform=lie.transform(np.eye(3), [side * 2.1, 0, 0]))
        for side in (-1, 1)
    ]
    dish = trimesh.creation.icosphere(subdivisions=2, radius=0.6)
    dish.apply_translation([0, 0.2, 1.1])
    boom = trimesh.creation.cylinder(0.12, 1.6)
    boom.apply_translation([0.5, 1.0, -0.5])
    return target_from_scene(trimesh.Scene([body, *panels, dish, boom]), "satellite")


def tumbling_poses(n_frames, step_deg=1.5, range_m=6.5):
    """(n, 4, 4) T_cam_target: a tumble about a slowly turning axis while the range and the bearing drift."""
    poses, R = [], lie.so3_exp(np.array([0.4, -0.3, 0.2]))
    for i in range(n_frames):
        phase = 2 * np.pi * i / 150
        axis = np.array([0.5 * np.cos(phase), 1.0, 0.4 * np.sin(phase)])
        R = lie.so3_exp(np.radians(step_deg) * axis / np.linalg.norm(axis)) @ R
        t = range_m * np.array([0.05 * np.sin(1.7 * phase), 0.04 * np.cos(phase), 1 + 0.12 * np.sin(phase)])
        poses.append(lie.transform(R, t))
    return np.stack(poses)


def numbered_image(number, height, width):
    """An image that says which frame of the clip it is; nothing else reads it."""
    return np.broadcast_to(np.array([number // 256, number % 256, 0], np.uint8), (height, width, 3))


@dataclass
class Clip:
    """Frames with their masks, the true poses, and depth at every eighth pixel."""

    frames: list[Frame]
    detections: list[Detection]
    T_cam_target: np.ndarray
    depth8: np.ndarray
    K8: np.ndarray


def make_clip(n_frames, width=256, height=192, focal=230.0, frame_ns=100_000_000, **motion):
    """A rendered clip."""
    camera = Camera(np.array([[focal, 0, width / 2 - 4], [0, focal, height / 2 - 4], [0, 0, 1.0]]), width, height)
    K8 = camera.K / STRIDE
    K8[2, 2] = 1
    small = Camera(K8, width // STRIDE, height // STRIDE)
    renderer = RayRenderer(satellite())
    poses = tumbling_poses(n_frames, **motion)
    depth8 = np.stack([renderer.render(T, small, color=False).depth_m for T in poses])
    frames = [Frame((i + 1) * frame_ns, numbered_image(i, height, width), camera) for i in range(n_frames)]
    detections = [Detection(np.kron(depth > 0, np.ones((STRIDE, STRIDE))).astype(bool)) for depth in depth8]
    return Clip(frames, detections, poses, depth8, K8)


def oracle_config(clip, **options):
    """Thresholds for these small images; all corrections on."""
    area = clip.frames[0].camera.width * clip.frames[0].camera.height
    settings = {"filter_threshold": 0.5, "keyframe_threshold": 0.4, "readout_depths": True, "as_released": False}
    return HatConfig(slam=SlamConfig(backend="droid", droid=DroidConfig(input_area_px=area, **(settings | options))))


class FlowOracle:
    """True flow in place of the network; which frame an image is, the image itself says."""

    dtype = torch.float32

    def __init__(self, clip, damping=5e-3):
        self.clip, self._damping = clip, damping
        h, w = clip.depth8.shape[1:]
        y, x = np.mgrid[:h, :w]
        self._rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(clip.K8).T

    def features(self, images_bgr):
        number = int(images_bgr[0, 2, 0, 0]) * 256 + int(images_bgr[0, 1, 0, 0])
        depth, T = self.clip.depth8[number], self.clip.T_cam_target[number]
        points = (self._rays * depth[..., None] - T[:3, 3]) @ T[:3, :3]
        pose = np.broadcast_to(T[:3].reshape(12), (*depth.shape, 12))
        stacked = np.concatenate([points, depth[..., None], pose], axis=-1).transpose(2, 0, 1)
        return torch.from_numpy(np.ascontiguousarray(stacked, dtype=np.float32))[None]

    def context(self, images_bgr):
        nothing = torch.zeros(1, 1, *self.clip.depth8.shape[1:])
        return nothing, nothing

    def correlation(self, features_i, features_j, stored):
        return TrueFlow(features_i, features_j, torch.from_numpy(self.clip.K8).float())

    def refine(self, hidden, inp, lookup, motion):
        lookup = lookup.permute(0, 2, 3, 1)
        return hidden, lookup[..., :2], lookup[..., 2:].expand(*lookup.shape[:3], 2)

    def damping(self, hidden, group, n_groups):
        return torch.full((n_groups, *hidden.shape[-2:]), self._damping)


class TrueFlow:
    """Where the points seen in frames i appear in frames j, and whether they are visible there."""

    def __init__(self, features_i, features_j, K8):
        _, _, h, w = features_i.shape
        points, seen = features_i[:, :3], features_i[:, 3] > 0
        T = features_j[:, 4:, 0, 0].view(-1, 3, 4)
        moved = torch.einsum("eab,ebhw->eahw", T[:, :, :3], points) + T[:, :, 3, None, None]
        image = torch.einsum("ab,ebhw->eahw", K8, moved)
        self.coords = (image[:, :2] / image[:, 2:].clamp_min(0.1)).permute(0, 2, 3, 1)
        nearest = self.coords.round().long()
        inside = (nearest >= 0).all(-1) & (nearest[..., 0] < w) & (nearest[..., 1] < h)
        index = nearest[..., 0].clamp(0, w - 1) + nearest[..., 1].clamp(0, h - 1) * w
        depth_there = features_j[:, 3].flatten(1).gather(1, index.flatten(1)).view_as(index)
        visible = (moved[:, 2] - depth_there).abs() < 0.1 * moved[:, 2]
        self.weight = (seen & inside & visible).float()
        self.seen = seen

    def lookup(self, coords):
        delta = torch.where(self.seen[..., None], self.coords - coords, torch.zeros_like(coords))
        return torch.cat([delta, self.weight[..., None]], dim=-1).permute(0, 3, 1, 2)

    def select(self, index):
        self.coords, self.weight, self.seen = (x[index] for x in (self.coords, self.weight, self.seen))

    def append(self, other):
        self.coords = torch.cat([self.coords, other.coords])
        self.weight = torch.cat([self.weight, other.weight])
        self.seen = torch.cat([self.seen, other.seen])


def track(slam, clip):
    """Motions of the whole clip."""
    return [slam.update(frame, seen, None) for frame, seen in zip(clip.frames, clip.detections, strict=True)]


def similarity_errors(T_slam_cam, T_cam_target):
    """Errors after the best similarity: rotation (n,) degrees, translation (n,) as a share of the range."""
    T_target_cam = lie.inverse(T_cam_target)
    R = T_target_cam[:, :3, :3] @ T_slam_cam[:, :3, :3].transpose(0, 2, 1)
    u, _, vt = np.linalg.svd(R.sum(0))
    R_target_slam = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    moved = T_slam_cam[:, :3, 3] @ R_target_slam.T
    true = T_target_cam[:, :3, 3]
    a, b = moved - moved.mean(0), true - true.mean(0)
    scale = (a * b).sum() / (a * a).sum()
    residual = b - scale * a
    rotation = lie.angle_between(R_target_slam @ T_slam_cam[:, :3, :3], T_target_cam[:, :3, :3])
    return np.degrees(rotation), np.linalg.norm(residual, axis=1) / np.linalg.norm(true, axis=1), scale
