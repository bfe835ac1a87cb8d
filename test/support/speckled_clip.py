"""A rendered clip for motion: a body with a painted texture that turns before a black sky or a moving backdrop."""

from dataclasses import dataclass

import cv2
import numpy as np
import trimesh

from hat_ros.geometry import lie
from hat_ros.target.loading import target_from_scene
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.types import Camera, Detection, Frame, PosePrior

CAMERA = Camera(np.array([[420.0, 0, 159.5], [0, 420.0, 119.5], [0, 0, 1]]), 320, 240)
FRAME_NS = 100_000_000


def model():
    """A box with one long panel and a dish: depth steps, no symmetry."""
    body = trimesh.creation.box((1.0, 0.8, 1.2))
    panel = trimesh.creation.box((1.6, 0.05, 0.7), transform=lie.transform(np.eye(3), [1.3, 0.1, 0.1]))
    dish = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    dish.apply_translation([-0.2, 0.1, 0.8])
    return target_from_scene(trimesh.Scene([body, panel, dish]), "speckled")


def paint(points_m):
    """Grey (n,) in 60..220 of target points (n, 3): a smooth solid texture without repetition."""
    rng = np.random.default_rng(7)
    waves = rng.normal(size=(24, 3)) * 9.0
    phase = rng.uniform(0, 2 * np.pi, 24)
    value = np.sin(points_m @ waves.T + phase).sum(axis=1) / np.sqrt(24)
    return 140 + 80 * np.tanh(value)


def turning_poses(n_frames, step_deg=1.5, range_m=5.0, seed=1):
    """(n, 4, 4) T_cam_target: constant rate about an oblique axis, drifting in bearing and range."""
    axis = np.array([0.5, 0.8, 0.3]) / np.linalg.norm([0.5, 0.8, 0.3])
    R = lie.so3_exp(np.array([0.4, -0.5, 0.2 * seed]))
    t = np.stack(
        [np.linspace(-0.2, 0.2, n_frames), np.linspace(0.1, -0.1, n_frames), np.linspace(0, -0.2, n_frames)], 1
    )
    turns = lie.so3_exp(np.radians(step_deg) * np.arange(n_frames)[:, None] * axis)
    return lie.transform(turns @ R, t + [0, 0, range_m])


def painted_wall(T_first, T_cam_target, rays):
    """(H, W) grey of a plane fixed in the target frame, 1.5 m behind its origin as the first camera sees it."""
    normal = T_first[2, :3]
    R, t = T_cam_target[:3, :3], T_cam_target[:3, 3]
    origin, directions = -t @ R, rays @ R
    points = origin + directions * ((1.5 - origin @ normal) / (directions @ normal))[..., None]
    return paint(points.reshape(-1, 3) * 0.6).reshape(rays.shape[:2])


@dataclass
class SpeckledClip:
    """Frames, detections and the truth."""

    target: object
    frames: list[Frame]
    detections: list[Detection]
    T_cam_target: np.ndarray

    def prior(self, index, delay_frames=4, turned=None, healthy=True):
        """The truth of an earlier frame as a prior, its target frame turned by a rotation."""
        past = index - delay_frames
        if past < 0:
            return None
        T = self.T_cam_target[past].copy()
        if turned is not None:
            T[:3, :3] = T[:3, :3] @ turned
        row = lie.row_from_matrix(T)
        return PosePrior(self.frames[past].stamp_ns, row, row, healthy, supported=healthy)


def speckled_clip(n_frames, backdrop=False, wall=False, **motion):
    """Render a clip; ``backdrop`` adds a bright texture behind the target that moves on its own, ``wall`` one that is
    fixed to the target."""
    target, poses = model(), turning_poses(n_frames, **motion)
    renderer, rng = RayRenderer(target), np.random.default_rng(3)
    clouds = cv2.GaussianBlur(rng.uniform(0, 255, (600, 900)), (0, 0), 3)
    clouds = np.clip(128 + 12 * (clouds - clouds.mean()), 0, 255)
    frames, detections = [], []
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(CAMERA.K).T
    for i, T in enumerate(poses):
        drawn = renderer.render(T, CAMERA, color=False)
        points = rays[drawn.mask] * drawn.depth_m[drawn.mask][:, None]
        grey = clouds[2 * i : 2 * i + 240, 5 * i : 5 * i + 320].copy() if backdrop else np.zeros(drawn.mask.shape)
        if wall:
            grey = painted_wall(poses[0], T, rays)
        grey[drawn.mask] = paint((points - T[:3, 3]) @ T[:3, :3])
        grey = np.clip(cv2.GaussianBlur(grey, (0, 0), 0.6) + rng.normal(0, 1.5, grey.shape), 0, 255).astype(np.uint8)
        frames.append(Frame((i + 1) * FRAME_NS, np.repeat(grey[..., None], 3, axis=2), CAMERA))
        detections.append(Detection(drawn.mask))
    return SpeckledClip(target, frames, detections, poses)


def turn_errors_deg(motions, T_cam_target, step=1):
    """Errors (n - step,) of the emitted turns over ``step`` frames, degrees; NaN where there is none."""
    errors = np.full(len(motions) - step, np.nan)
    for i in range(len(errors)):
        a, b = motions[i], motions[i + step]
        if a.valid and b.valid and a.epoch == b.epoch:
            found = b.T_slam_cam[:3, :3].T @ a.T_slam_cam[:3, :3]
            true = T_cam_target[i + step, :3, :3] @ T_cam_target[i, :3, :3].T
            errors[i] = np.degrees(lie.angle_between(found, true))
    return errors
