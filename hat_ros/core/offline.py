"""The paper's offline reference for Stages 3 and 4: what hindsight would have answered. Never causal.

Over recorded observations of a whole sequence: the decoder's path is traced back from its end, the running gate becomes
one verdict over all keyframes, each SLAM epoch is aligned once to all its anchors, and the poses of all frames are
optimised together over the residuals of eq. (fusionresiduals).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hat_ros import lie
from hat_ros.config import HatConfig, SelectorConfig
from hat_ros.core.alignment import SlamAlignment
from hat_ros.core.causal import AreaConfidence, relative_motion
from hat_ros.core.pose_graph import PoseGraph
from hat_ros.core.selector import RunningGate, box_area_px, motion_penalty, scaled_score
from hat_ros.types import Candidates, Float, Motion


@dataclass(frozen=True)
class OfflineResult:
    """Hindsight for N frames.

    Attributes:
        T_cam_target: (N, 4, 4) poses; NaN only when there is no anchor at all.
        chosen: (N,) index of the anchor among the frame's candidates, -1 where there is none.
    """

    T_cam_target: Float
    chosen: NDArray[np.int64]


def solve_offline(candidates: Sequence[Candidates], motions: Sequence[Motion], config: HatConfig) -> OfflineResult:
    """Decode, align and optimise a whole sequence.

    Args:
        candidates: per frame, guarded; zero rows between keyframes.
        motions: per frame.
        config: the same as for the causal method.
    """
    chosen = backtrace(candidates, motions, config.selector)
    confidence = AreaConfidence(config.fusion)
    graph = PoseGraph(len(motions), config.fusion, config.alignment.lever_m_per_rad)
    aligned = _align_epochs(candidates, motions, chosen, config)
    for frame, index in enumerate(chosen):
        if frame in aligned:
            graph.add_pose(frame, aligned[frame][0])
        if index >= 0:
            anchor = candidates[frame].T_cam_target[index]
            weight = confidence.update(box_area_px(candidates[frame].box_xyxy))
            if frame in aligned and _disagree(anchor, aligned[frame][0], config):
                weight *= config.fusion.gate_weight
            else:
                graph.add_pose(frame, anchor)
            graph.add_anchor(frame, anchor, weight)
        if frame in aligned and frame - 1 in aligned:
            step = relative_motion(motions[frame - 1], motions[frame], aligned[frame][1])
            if step is not None:
                graph.add_step(frame, step)
    return OfflineResult(_hold(graph.solve()), chosen)


def backtrace(candidates: Sequence[Candidates], motions: Sequence[Motion], config: SelectorConfig) -> NDArray[np.int64]:
    """The path of eq. (viterbi) through all keyframes: (N,) candidate index, -1 where there is none.

    With ``running_gate`` the path counts only if the median support over all keyframes and the share of keyframes
    where it overrides appearance pass; otherwise every keyframe takes its best appearance.
    """
    keyframes, alive, scaled, pointers = [], [], [], []
    score = np.zeros(0)
    for frame, group in enumerate(candidates):
        scores = scaled_score(group, config)
        survivors = np.flatnonzero(np.isfinite(scores))
        if len(survivors) == 0:
            continue
        if keyframes:
            last = keyframes[-1]
            penalty = motion_penalty(
                candidates[last], alive[-1], motions[last], group, survivors, motions[frame], config
            )
            history = score[None, :] - penalty
            pointers.append(np.argmax(history, axis=1))
            score = scores[survivors] + history.max(axis=1)
            score -= score.max()
        else:
            score = scores[survivors]
        keyframes.append(frame)
        alive.append(survivors)
        scaled.append(scores)

    chosen = np.full(len(candidates), -1)
    best = np.array([int(np.argmax(scores)) for scores in scaled], dtype=np.int64)
    path = np.zeros(len(keyframes), dtype=np.int64)
    end = int(np.argmax(score)) if keyframes else 0
    for j in range(len(keyframes) - 1, -1, -1):
        path[j] = alive[j][end]
        end = int(pointers[j - 1][end]) if j else 0
    gate = RunningGate(config)
    for j, frame in enumerate(keyframes):
        gate.observe(candidates[frame], alive[j], int(best[j]), int(path[j]))
    chosen[keyframes] = path if gate.open else best
    return chosen


def _align_epochs(
    candidates: Sequence[Candidates], motions: Sequence[Motion], chosen: NDArray[np.int64], config: HatConfig
) -> dict[int, tuple[Float, float]]:
    """Frame -> aligned SLAM pose (4, 4) and metres per SLAM unit, for epochs with enough joint observations."""
    alignments: dict[int, SlamAlignment] = {}
    for frame, motion in enumerate(motions):
        if motion.valid and chosen[frame] >= 0:
            alignment = alignments.setdefault(motion.epoch, SlamAlignment(config.alignment))
            alignment.observe(candidates[frame].T_cam_target[chosen[frame]], motion.T_slam_cam)
    for epoch, alignment in alignments.items():
        alignment.update(epoch)
    out = {}
    for frame, motion in enumerate(motions):
        alignment = alignments.get(motion.epoch)
        if motion.valid and alignment is not None and alignment.current is not None:
            out[frame] = (alignment.aligned(motion.T_slam_cam), alignment.current.scale)
    return out


def _disagree(anchor: Float, aligned: Float, config: HatConfig) -> bool:
    angle_rad = lie.angle_between(anchor[:3, :3], aligned[:3, :3])
    return bool(angle_rad > np.radians(config.fusion.gate_angle_deg))


def _hold(poses: Float) -> Float:
    """Fill frames without a pose with the last one before, or the first one after."""
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    if len(known) == 0:
        return poses
    source = known[np.maximum(np.searchsorted(known, np.arange(len(poses)), side="right") - 1, 0)]
    return poses[source]
