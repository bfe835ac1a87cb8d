"""The paper's offline reference for Stages 3 and 4: whole-clip smoothing. Never causal.

Over recorded observations of a whole sequence: the decoder's path is traced back from its end, the running gate becomes
one decision over all keyframes, each SLAM epoch is aligned once to its anchors, and the poses of all frames are
optimised together. The causal gate weakens an anchor that disagrees with the motion because it cannot know which of
the two is wrong; over the whole clip that shows, so an anchor that does not fit the others counts for nothing
(:func:`consistent`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hat_ros.array_types import Bool, Float, Int
from hat_ros.bench.methods.pose_graph import PoseGraph
from hat_ros.config import HatConfig, SelectorConfig
from hat_ros.core.alignment import SlamAlignment
from hat_ros.core.published_fusion import AreaConfidence, relative_motion
from hat_ros.core.selector import RunningGate, box_area_px, motion_penalty, scaled_score
from hat_ros.geometry import lie
from hat_ros.types import Candidates, Motion

# Random rotations agree within 75 degrees one time in nine, so motion that fits nothing links a fifth of the anchors.
_CREDIBLE_SHARE = 1.0 / 3.0
# A pose measured on one image and a step between two images count the same.
_DENSE_STEP_WEIGHT = 1.0
# Residuals beyond this many standard deviations are outliers, and differences below this are none.
_OUTLIER_SIGMAS = 2.0
_EXACT = 1e-9
# From the median size of normally distributed numbers to their standard deviation.
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class Smoothed:
    """The smoothed answer for N frames.

    Attributes:
        T_cam_target: (N, 4, 4) poses; NaN only when there is no anchor at all.
        chosen: (N,) index of the anchor among the frame's candidates, -1 where there is none.
        gate_weight: (N,) 1 for an anchor that counted, 0 for one that was left out, NaN where there is none.
        tied: (N,) motion ties the pose to other frames' anchors; False where an anchor stands alone or a pose is held.
    """

    T_cam_target: Float
    chosen: Int
    gate_weight: Float
    tied: Bool


def smooth_anchors(candidates: Sequence[Candidates], motions: Sequence[Motion], config: HatConfig) -> Smoothed:
    """Decode, gate, align and optimise a whole sequence.

    Args:
        candidates: per frame, guarded; zero rows between keyframes.
        motions: per frame.
        config: the same as for the causal method.
    """
    chosen = backtrace(candidates, motions, config.selector)
    confidence = AreaConfidence(config.fusion)
    graph = PoseGraph(len(motions), config.fusion, config.alignment.lever_m_per_rad)
    anchors, gate_weight, tied = {}, np.full(len(motions), np.nan), np.zeros(len(motions), dtype=bool)
    for frame in map(int, np.flatnonzero(chosen >= 0)):
        anchors[frame] = candidates[frame].T_cam_target[chosen[frame]]
        gate_weight[frame] = 1.0
    for epoch in sorted({motion.epoch for motion in motions if motion.valid}):
        joint = [frame for frame in anchors if motions[frame].valid and motions[frame].epoch == epoch]
        kept = consistent([anchors[frame] for frame in joint], [motions[frame] for frame in joint], config)
        gate_weight[[frame for frame, keep in zip(joint, kept, strict=True) if not keep]] = 0.0
        counted = {frame: anchors[frame] for frame in joint if gate_weight[frame]}
        tied[_add_epoch(graph, motions, epoch, counted, _scale(motions, epoch, counted, config))] = True
    for frame, anchor in anchors.items():
        weight = confidence.update(box_area_px(candidates[frame].box_xyxy))
        if gate_weight[frame]:
            graph.add_pose(frame, anchor)
            graph.add_anchor(frame, anchor, weight)
    return Smoothed(_hold(graph.solve()), chosen, gate_weight, tied)


def smooth_measured(T_measured: Float, motions: Sequence[Motion], config: HatConfig) -> Float:
    """The joint optimum of poses measured on (nearly) every image and the motion between them.

    The error of a measured pose jitters from frame to frame, that of the motion grows slowly; each step counts as much
    as a measurement, so that a pose is in effect the mean over a few frames on either side. How far steps and
    measurements usually disagree, in rotation and in position, sets the lever between the two and the scale from which
    a residual is an outlier.

    Args:
        T_measured: (N, 4, 4) ``T_cam_target``, NaN at frames that were not measured.
        motions: per frame.
        config: rules of the alignment; lever and loss where no step tells them.

    Returns:
        (N, 4, 4) poses; NaN at frames that no motion connects to a measured one.
    """
    measured = {int(i): T_measured[i] for i in np.flatnonzero(np.isfinite(T_measured).all(axis=(1, 2)))}
    epochs = {}
    for epoch in sorted({motion.epoch for motion in motions if motion.valid}):
        here = {i: T for i, T in measured.items() if motions[i].valid and motions[i].epoch == epoch}
        epochs[epoch] = here, _scale(motions, epoch, here, config)
    differences = [
        _difference(step, here[i - 1], here[i])
        for here, scale in epochs.values()
        for i in here
        if i - 1 in here and scale and (step := relative_motion(motions[i - 1], motions[i], scale)) is not None
    ]
    lever, delta = _residual_scales(differences, config)
    fusion = replace(config.fusion, relative_weight=_DENSE_STEP_WEIGHT, huber_delta_m=delta, loss="huber")
    graph = PoseGraph(len(motions), fusion, lever)
    for epoch, (here, scale) in epochs.items():
        _add_epoch(graph, motions, epoch, here, scale)
    for frame, T in measured.items():
        graph.add_pose(frame, T)
        graph.add_anchor(frame, T, 1.0)
    return graph.solve()


def _residual_scales(differences: list[Float], config: HatConfig) -> tuple[float, float]:
    """Lever in m/rad that makes turn and shift alike, and the residual in metres from which one is an outlier."""
    if differences:
        sigma_rad, sigma_m = _MAD_TO_SIGMA * np.median(np.abs(differences), axis=(0, 2))
        if sigma_rad > _EXACT and sigma_m > _EXACT:
            return float(sigma_m / sigma_rad), float(_OUTLIER_SIGMAS * sigma_m)
    return config.alignment.lever_m_per_rad, config.fusion.huber_delta_m


def _difference(step: Float, T_before: Float, T_after: Float) -> Float:
    """What separates a pose from the step applied to the one before: (2, 3) rotation vector, shift in metres."""
    predicted = step @ T_before
    turn = lie.so3_log((predicted[:3, :3] @ T_after[:3, :3].T)[None])[0]
    return np.stack([turn, predicted[:3, 3] - T_after[:3, 3]])


def consistent(anchors: Sequence[Float], motions: Sequence[Motion], config: HatConfig) -> Bool:
    """Which anchors of one SLAM epoch belong to the longest history that the motion can tell: (n,) flags.

    A history passes through anchors in order. Each one counts one; going on to an anchor whose rotation, propagated by
    the motion, is more than D away costs ``reset_anchors``, so a rotation basin is entered only where enough anchors
    stand for it. (The causal reset by four coherent anchors, in both directions of time. Only neighbours in the history
    are compared, so the motion may drift.) If even the longest holds less than a third of the
    anchors, it is the motion that cannot be believed, and all are kept.

    Args:
        anchors: n poses ``T_cam_target`` (4, 4) in order.
        motions: n valid motions of one epoch.
        config: D and ``reset_anchors``.
    """
    n = len(anchors)
    gate_rad, cost = np.radians(config.fusion.gate_angle_deg), config.alignment.reset_anchors
    # Every anchor's reading of the rotation between SLAM and target: the same for all if all is well.
    readings = np.array([m.T_slam_cam[:3, :3] @ T[:3, :3] for m, T in zip(motions, anchors, strict=True)])
    length, before = np.ones(n), np.full(n, -1)
    for j in range(1, n):
        disagree = lie.angle_between(readings[:j], readings[j]) > gate_rad
        lengths = length[:j] - cost * disagree
        # Among equals the latest: drift has had the least time.
        best = j - 1 - int(np.argmax(lengths[::-1]))
        if lengths[best] > 0:
            length[j] += lengths[best]
            before[j] = best
    kept = np.zeros(n, dtype=bool)
    at = n - 1 - int(np.argmax(length[::-1])) if n else -1
    while at >= 0:
        kept[at] = True
        at = int(before[at])
    return kept if np.count_nonzero(kept) >= _CREDIBLE_SHARE * n else np.ones(n, dtype=bool)


def backtrace(candidates: Sequence[Candidates], motions: Sequence[Motion], config: SelectorConfig) -> Int:
    """The path of eq. (viterbi) through all keyframes: (N,) candidate index, -1 where there is none.

    With ``running_gate`` the path counts only if the median support over all keyframes and the share of keyframes
    where it overrides appearance pass; otherwise every keyframe takes its best appearance.
    """
    keyframes: list[int] = []
    alive: list[Int] = []
    scaled: list[Float] = []
    pointers: list[Int] = []
    score = np.zeros(0)
    for frame, group in enumerate(candidates):
        scores = scaled_score(group, config)
        survivors = np.flatnonzero(np.isfinite(scores))
        if len(survivors) == 0:
            continue
        if keyframes:
            last = keyframes[-1]
            penalty = motion_penalty(
                candidates[last], alive[-1], motions[last], group, survivors, motions[frame], frame - last, config
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


def _scale(motions: Sequence[Motion], epoch: int, anchors: dict[int, Float], config: HatConfig) -> float:
    """Metres per SLAM unit of an epoch by its anchors; 0 where they are too few to tell."""
    alignment = SlamAlignment(config.alignment)
    for frame, anchor in anchors.items():
        alignment.observe(anchor, motions[frame].T_slam_cam)
    alignment.update(epoch)
    return 0.0 if alignment.current is None else alignment.current.scale


def _add_epoch(
    graph: PoseGraph, motions: Sequence[Motion], epoch: int, anchors: dict[int, Float], scale: float
) -> list[int]:
    """Poses and steps of a SLAM epoch whose scale is known; returns its frames."""
    if not scale:
        return []
    at, frames = np.array(list(anchors)), []
    for frame, motion in enumerate(motions):
        if not motion.valid or motion.epoch != epoch:
            continue
        # The motion drifts: the nearest anchor knows best where the search should start.
        nearest = int(at[np.argmin(np.abs(at - frame))])
        carried = relative_motion(motions[nearest], motion, scale)
        assert carried is not None  # both are valid and of one epoch
        graph.add_pose(frame, carried @ anchors[nearest])
        frames.append(frame)
        step = relative_motion(motions[frame - 1], motion, scale) if frame else None
        if step is not None:
            graph.add_step(frame, step)
    return frames


def _hold(poses: Float) -> Float:
    """Fill frames without a pose with the last one before, or the first one after."""
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    if len(known) == 0:
        return poses
    source = known[np.maximum(np.searchsorted(known, np.arange(len(poses)), side="right") - 1, 0)]
    return poses[source]
