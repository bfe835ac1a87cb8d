"""A tumbling target seen by a perfect or imperfect front end: recorded observations with known truth."""

from dataclasses import dataclass, replace

import numpy as np

from hat_ros.bench.observations import Observations
from hat_ros.config import load_config
from hat_ros.geometry import lie

HALF_TURN = lie.so3_exp(np.array([0.0, np.pi, 0.0]))


@dataclass(frozen=True)
class Scene:
    T_cam_target: np.ndarray
    observations: Observations


def make_scene(
    n=120,
    k=5,
    gap=4,
    seed=0,
    noise_deg=2.0,
    noise_m=0.03,
    rate_deg=1.0,
    scale=2.5,
    competing_score=0.7,
    gauge=None,
):
    """Observations whose candidates are the true pose, its half-turned competitor and random poses, all with noise."""
    rng = np.random.default_rng(seed)
    axis = np.array([0.3, 1.0, 0.2]) / np.linalg.norm([0.3, 1.0, 0.2])
    R0 = lie.so3_exp(rng.normal(size=3))
    frames = np.arange(n)
    R = lie.so3_exp(np.radians(rate_deg) * frames[:, None] * axis) @ R0
    t = np.stack([0.2 * np.sin(frames / 50), 0.1 + 0 * frames, 8 + np.cos(frames / 200)], axis=1)
    T_cam_target = lie.transform(R, t)
    gauge = lie.transform(lie.so3_exp(rng.normal(size=3)), rng.normal(size=3)) if gauge is None else gauge
    slam = gauge @ lie.inverse(T_cam_target)
    slam[:, :3, 3] /= scale
    key = frames % gap == 0
    poses, scores = np.full((n, k, 4, 4), np.nan), np.full((n, k), np.nan)
    for i in np.flatnonzero(key):
        for j in range(k):
            basin = (np.eye(3), HALF_TURN)[j] if j < 2 else lie.so3_exp(rng.normal(size=3) * 2)
            noisy = lie.so3_exp(np.radians(noise_deg) * rng.normal(size=3)) @ R[i] @ basin
            poses[i, j] = lie.transform(noisy, t[i] + noise_m * rng.normal(size=3))
            scores[i, j] = (0.8, competing_score, 0.5, 0.45, 0.4, *[0.3] * 60)[j] + 0.08 * rng.normal()
        order = rng.permutation(k)
        poses[i], scores[i] = poses[i, order], np.abs(scores[i, order]) + 1e-3
    area = (600.0 / t[:, 2]) ** 2
    return Scene(T_cam_target, Observations(slam, key, poses, scores, area))


def preset(name="mega_hat", **sections):
    """A preset with some fields of some sections replaced: preset(fusion={"relative_weight": 0.0})."""
    config = load_config(name)
    for section, changes in sections.items():
        config = replace(config, **{section: replace(getattr(config, section), **changes)})
    return config


def rotation_error_deg(T_a, T_b):
    return np.degrees(lie.angle_between(T_a[..., :3, :3], T_b[..., :3, :3]))
