"""Front ends that know the answer: the right pose and a half-turned one, which looks better at every third frame."""

from __future__ import annotations

import numpy as np
from scripted import FIRST_NS, STEP_NS

from hat_ros.geometry import lie
from hat_ros.types import Candidates, Motion

HALF_TURN = lie.so3_exp(np.array([0.0, 0.0, np.pi]))


def index_of(stamp_ns: int) -> int:
    return (stamp_ns - FIRST_NS) // STEP_NS


def true_pose(index: int) -> np.ndarray:
    R = lie.so3_exp(np.radians([1.0 * index, 0.5 * index, 0.0])) @ lie.so3_exp(np.array([0.9, 0.3, -0.2]))
    return lie.transform(R, np.array([0.002 * index, 0.0, 0.9 + 0.002 * index]))


class KnowingHypotheses:
    def __init__(self, config, target) -> None:
        pass

    def generate(self, frame, detection, prior) -> Candidates:
        index = index_of(frame.stamp_ns)
        right = true_pose(index)
        wrong = right.copy()
        wrong[:3, :3] = right[:3, :3] @ HALF_TURN
        flipped = index % 3 == 2
        return Candidates.from_matrices(np.array([right, wrong]), np.array([0.0, 1.0] if flipped else [1.0, 0.0]))

    def reset(self) -> None:
        pass


class KnowingSlam:
    def __init__(self, config, target) -> None:
        pass

    def update(self, frame, detection, prior) -> Motion:
        T_slam_cam = lie.inverse(true_pose(index_of(frame.stamp_ns)))
        return Motion(True, 0, lie.row_from_matrix(T_slam_cam))

    def reset(self) -> None:
        pass


class ReversedSlam(KnowingSlam):
    """Turns the wrong way, as a relief seen with its depth reversed does."""

    def update(self, frame, detection, prior) -> Motion:
        T_slam_cam = lie.inverse(true_pose(-index_of(frame.stamp_ns)))
        return Motion(True, 0, lie.row_from_matrix(T_slam_cam))


class NoSlam(KnowingSlam):
    """Never knows anything."""

    def update(self, frame, detection, prior) -> Motion:
        return Motion.none()


seen_whole_clip: list[tuple[int, int]] = []


def knowing_whole_clip(config, clip) -> list[Motion]:
    """The right motion of a whole clip; notes each stamp and the brightest pixel beside the mask."""
    seen_whole_clip[:] = [(frame.stamp_ns, int(frame.rgb[~detection.mask].max())) for frame, detection in clip]
    return [KnowingSlam(config, None).update(frame, detection, None) for frame, detection in clip]
