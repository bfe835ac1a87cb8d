"""A run of ``--mode observe`` made by hand: right and half-turned candidates at every frame, and perfect motion."""

import numpy as np

from hat_ros.config import load_config
from hat_ros.geometry import lie
from hat_ros.io.run_log import RunLogBuilder
from hat_ros.types import Candidates, Estimate, Motion, TrackState

N = 80
# The published estimator; w, D and warm-up are not those of mega_hat, so that each row of a table differs from it.
CONFIG = load_config(
    "mega_hat", ("fusion.relative_weight=0.1", "fusion.gate_angle_deg=30", "selector.warmup_keyframes=1")
)
FLIP = lie.so3_exp(np.array([0.0, np.pi, 0.0]))


def true_pose(i, rate_deg=2.0):
    R = lie.so3_exp(np.radians([rate_deg * i, 0, 0])) @ lie.so3_exp(np.array([0.3, -0.5, 0.8]))
    return lie.transform(R, np.array([0.2 * np.sin(i / 9), 0.1, 6 + 0.02 * i]))


def observations(flip_every=0, noise_deg=0.5, seed=0, motion=True, n=N):
    """Right and half-turned candidates at every frame; at every ``flip_every``-th the wrong one looks better."""
    rng = np.random.default_rng(seed)
    gauge = lie.transform(lie.so3_exp(np.array([1.0, 2.0, 0.5])), np.array([3.0, -1.0, 2.0]))
    builder, truth = RunLogBuilder(), {}
    for i in range(n):
        T = true_pose(i)
        stamp = 1_000_000_000 + i * 100_000_000
        truth[stamp] = lie.row_from_matrix(T)
        noisy = T.copy()
        noisy[:3, :3] = lie.so3_exp(np.radians(noise_deg) * rng.standard_normal(3)) @ T[:3, :3]
        wrong = noisy.copy()
        wrong[:3, :3] = noisy[:3, :3] @ FLIP
        better = [0.0, 0.3] if flip_every and i % flip_every == flip_every - 1 else [0.3, 0.0]
        candidates = Candidates.from_matrices(np.array([noisy, wrong]), np.array(better), np.array([10, 10, 110, 110]))
        step = Motion.none()
        if motion:
            T_slam_cam = gauge @ lie.inverse(T)
            T_slam_cam[:3, 3] /= 2.5
            step = Motion(True, 0, lie.row_from_matrix(T_slam_cam))
        nothing = Estimate(stamp, TrackState.UNINITIALISED, np.full(7, np.nan), np.full((6, 6), np.nan), keyframe=True)
        builder.add(candidates, step, nothing)
    return builder.build(truth)
