"""Stages 3 and 4 over what the front ends saw once: a temporal setting costs a second instead of a run.

The observations are a result bag of ``--mode observe``: candidates at every frame, motion at every frame.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from hat_ros.bench.methods.smoothing import solve_offline
from hat_ros.bench.temporal import Observations
from hat_ros.config import HatConfig
from hat_ros.core.fusion import FusionStage
from hat_ros.core.keyframes import KeyframeSchedule
from hat_ros.core.published_fusion import PublishedFusion
from hat_ros.core.selector import SelectorStage, box_area_px
from hat_ros.geometry import lie
from hat_ros.io.run_log import RunLog, RunLogBuilder
from hat_ros.types import Camera, Candidates, Estimate, Frame, Motion, Selection, TrackState

_HALF_TURN = np.diag([1.0, -1.0, -1.0])
_HOPELESS = 1e6


class Selector(Protocol):
    """Whatever chooses one candidate per keyframe: Stage 3, or a filter in its place."""

    def update(self, candidates: Candidates, motion: Motion) -> Selection:
        """One frame; ``Selection.none()`` without candidates."""
        ...


def keyframes_of(log: RunLog, config: HatConfig) -> list[Candidates]:
    """The candidates that a run with this keyframe gap and K would have seen: N sets, empty between keyframes."""
    schedule = KeyframeSchedule(config.keyframes)
    keep = config.hypotheses.max_candidates
    out = []
    for group in log.candidates:
        due = schedule.update(len(group) > 0)
        out.append(
            Candidates(group.pose_rows[:keep], group.log_score[:keep], group.box_xyxy) if due else Candidates.none()
        )
    return out


def replay_temporal(log: RunLog, config: HatConfig, selector: Selector | None = None) -> RunLog:
    """Selection, alignment and fusion as published (no refinement on images) over recorded observations.

    As in ``hat temporal`` a pose is given for every frame after the first anchor: nothing is ever LOST.

    Args:
        log: observations of ``--mode observe``.
        config: temporal configuration; its keyframe gap and K are applied to the observations.
        selector: takes the place of Stage 3.
    """
    config = replace(config, fusion=replace(config.fusion, coast_limit_frames=max(1, len(log))))
    selector = selector or SelectorStage(config.selector)
    fusion = FusionStage(config, PublishedFusion(config))
    builder = RunLogBuilder()
    for i, candidates in enumerate(keyframes_of(log, config)):
        motion = log.motion(i)
        selection = selector.update(candidates, motion)
        estimate = fusion.update(_imageless(int(log.stamp_ns[i])), None, motion, selection)
        builder.add(candidates, motion, estimate)
    return _beside_truth(builder, log)


def replay_offline(log: RunLog, config: HatConfig) -> RunLog:
    """The offline reference over the same observations."""
    candidates = keyframes_of(log, config)
    motions = [log.motion(i) for i in range(len(log))]
    result = solve_offline(candidates, motions, config)
    builder = RunLogBuilder()
    for i, T in enumerate(result.T_cam_target):
        known = bool(np.isfinite(T).all())
        estimate = Estimate(
            int(log.stamp_ns[i]),
            TrackState.TRACKING if known else TrackState.UNINITIALISED,
            lie.row_from_matrix(T) if known else np.full(7, np.nan),
            np.full((6, 6), np.nan),
            keyframe=len(candidates[i]) > 0,
            n_candidates=len(candidates[i]),
            anchor=int(result.chosen[i]),
            gate_weight=float(result.gate_weight[i]),
            slam_epoch=motions[i].epoch,
        )
        builder.add(candidates[i], motions[i], estimate)
    return _beside_truth(builder, log)


def observations_of(log: RunLog) -> Observations:
    """The same observations in the form that ``hat temporal`` reads.

    That form has one SLAM gauge and the same K everywhere. So only the longest SLAM epoch keeps its motion, and
    frames with fewer candidates are filled up with ones that can neither win nor support another: turned away from
    the best one by 180 degrees, with a score far below all others.
    """
    k = max((len(group) for group in log.candidates), default=1) or 1
    poses = np.tile(np.eye(4), (len(log), k, 1, 1))
    scores = np.zeros((len(log), k))
    area_px = np.full(len(log), np.nan)
    for i, group in enumerate(log.candidates):
        if len(group):
            area_px[i] = box_area_px(group.box_xyxy)
            poses[i] = group.T_cam_target[0] @ lie.transform(_HALF_TURN, np.zeros(3))
            scores[i] = group.log_score.min() - _HOPELESS
            poses[i, : len(group)], scores[i, : len(group)] = group.T_cam_target, group.log_score
    epochs, counts = np.unique(log.slam_epoch[log.motion_valid], return_counts=True)
    longest = epochs[np.argmax(counts)] if len(epochs) else -1
    usable = log.motion_valid & (log.slam_epoch == longest)
    slam = np.full((len(log), 4, 4), np.nan)
    slam[usable] = lie.matrix_from_row(log.motion_rows[usable])
    return Observations(slam, np.array([len(group) > 0 for group in log.candidates]), poses, scores, area_px)


def save_observations(path: Path, log: RunLog) -> None:
    """Write :func:`observations_of` as the ``.npz`` that ``hat temporal`` reads."""
    with path.open("wb") as file:
        np.savez_compressed(file, **vars(observations_of(log)))


def _beside_truth(builder: RunLogBuilder, log: RunLog) -> RunLog:
    known = np.flatnonzero(log.has_truth)
    return builder.build({int(log.stamp_ns[i]): log.truth_rows[i] for i in known})


def _imageless(stamp_ns: int) -> Frame:
    """A frame of which only the stamp is ever read."""
    return Frame(stamp_ns, np.zeros((1, 1, 3), dtype=np.uint8), Camera(np.eye(3), 1, 1))
