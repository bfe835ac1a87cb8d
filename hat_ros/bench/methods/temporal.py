"""Stages 3 and 4 alone over recorded observations: a temporal setting costs a second instead of a run.

The stages are the very objects of the tracker, without refinement (there are no images). So a pose is held for as long
as it is in a run with the same configuration: without a limit in the paper's presets.

Two forms of observations, two forms of answers: :class:`~hat_ros.bench.observations.Observations` (``hat temporal``)
gives a :class:`TemporalResult`; the :class:`~hat_ros.io.run_log.RunLog` of ``--mode observe`` (``hat ablate``) gives a
run that is scored like any other.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from hat_ros.array_types import Bool, Float, Int
from hat_ros.bench.methods.smoothing import smooth_anchors
from hat_ros.bench.observations import Observations
from hat_ros.config import HatConfig
from hat_ros.core.fusion import FusionStage
from hat_ros.core.keyframes import KeyframeSchedule
from hat_ros.core.published_fusion import PublishedFusion
from hat_ros.core.selector import SelectorStage
from hat_ros.errors import InputError
from hat_ros.geometry import lie
from hat_ros.io.run_log import RunLog, RunLogBuilder
from hat_ros.types import Camera, Candidates, Estimate, Frame, Motion, Selection, TrackState


class Selector(Protocol):
    """What chooses one candidate per keyframe: Stage 3, or a filter in its place."""

    def update(self, candidates: Candidates, motion: Motion) -> Selection:
        """One frame; ``Selection.none()`` without candidates."""
        ...


@dataclass(frozen=True)
class TemporalResult:
    """The causal answer for N frames.

    Attributes:
        T_cam_target: (N, 4, 4) output, NaN before the first and while LOST; the last valid pose where ``held``.
        chosen: (N,) int, index of the anchor among the recorded candidates, -1 where there is none.
        accepted: (N,) bool, the decoder's own proposal became the anchor: warm-up over, running gate open.
        resets: (M,) int, frames at which the alignment was dropped.
        held: (N,) bool, no output was possible and the last one (or its gap-filled successor) stands in.
    """

    T_cam_target: Float
    chosen: Int
    accepted: Bool
    resets: Int
    held: Bool


def run_temporal(observations: Observations, config: HatConfig) -> TemporalResult:
    """Run Stages 3 and 4 over recorded observations, causally.

    Raises:
        CandidateError: a candidate at a keyframe is malformed and ``hypotheses.guard`` is off.
    """
    n = len(observations)
    T_cam_target, held = np.full((n, 4, 4), np.nan), np.zeros(n, dtype=bool)
    chosen, accepted, n_resets = np.full(n, -1), np.zeros(n, dtype=bool), np.zeros(n + 1, dtype=int)
    selector = SelectorStage(config.selector)
    observed = ((observations.candidates(t, config.hypotheses.guard), observations.motion(t)) for t in range(n))
    for t, (selection, estimate) in enumerate(_causal(range(1, n + 1), observed, config, selector)):
        if estimate.state.has_pose:
            T_cam_target[t], held[t] = estimate.T_cam_target, estimate.state == TrackState.COASTING
        chosen[t], accepted[t], n_resets[t + 1] = selection.selected, selector.accepted, estimate.n_resets
    return TemporalResult(T_cam_target, chosen, accepted, np.flatnonzero(np.diff(n_resets)), held)


def run_offline(observations: Observations, config: HatConfig) -> TemporalResult:
    """The whole-clip solution of the same observations, not causal (:mod:`hat_ros.bench.methods.smoothing`).

    ``accepted`` marks the anchors that counted; there are no resets, and no output is held.

    Raises:
        CandidateError: as in :func:`run_temporal`.
    """
    n = len(observations)
    candidates = [observations.candidates(t, config.hypotheses.guard) for t in range(n)]
    result = smooth_anchors(candidates, [observations.motion(t) for t in range(n)], config)
    accepted = result.gate_weight == 1.0
    no_resets, not_held = np.zeros(0, dtype=np.int64), np.zeros(n, dtype=bool)
    return TemporalResult(result.T_cam_target, result.chosen, accepted, no_resets, not_held)


def replay_temporal(log: RunLog, config: HatConfig, selector: Selector | None = None) -> RunLog:
    """Selection, alignment and fusion as published (no refinement on images) over a run of ``--mode observe``.

    Args:
        log: candidates and motion of every frame.
        config: temporal configuration; its keyframe gap and K are applied to the observations.
        selector: takes the place of Stage 3.
    """
    candidates, motions = keyframes_of(log, config), [log.motion(i) for i in range(len(log))]
    observed = list(zip(candidates, motions, strict=True))
    stamps = [int(stamp_ns) for stamp_ns in log.stamp_ns]
    builder = RunLogBuilder()
    answers = _causal(stamps, observed, config, selector or SelectorStage(config.selector))
    for (group, motion), (_, estimate) in zip(observed, answers, strict=True):
        builder.add(group, motion, estimate)
    return _beside_ground_truth(builder, log)


def replay_offline(log: RunLog, config: HatConfig) -> RunLog:
    """The whole-clip solution over the same observations."""
    candidates = keyframes_of(log, config)
    motions = [log.motion(i) for i in range(len(log))]
    result = smooth_anchors(candidates, motions, config)
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
    return _beside_ground_truth(builder, log)


def keyframes_of(log: RunLog, config: HatConfig) -> list[Candidates]:
    """The candidates that a run with this keyframe gap and K would have seen: N sets, empty between keyframes."""
    schedule = KeyframeSchedule(config.keyframes)
    keep = config.hypotheses.max_candidates
    out = []
    for group in log.candidates:
        due = schedule.update(len(group) > 0)
        out.append(group.first(keep) if due else Candidates.none())
    return out


def _causal(
    stamps: Sequence[int], observed: Iterable[tuple[Candidates, Motion]], config: HatConfig, selector: Selector
) -> Iterator[tuple[Selection, Estimate]]:
    """Stages 3 and 4 frame by frame."""
    fusion = FusionStage(config, PublishedFusion(config))
    for stamp_ns, (candidates, motion) in zip(stamps, observed, strict=True):
        selection = selector.update(candidates, motion)
        yield selection, fusion.update(_imageless(stamp_ns), None, motion, selection)


def _beside_ground_truth(builder: RunLogBuilder, log: RunLog) -> RunLog:
    known = np.flatnonzero(log.has_truth)
    return builder.build({int(log.stamp_ns[i]): log.truth_rows[i] for i in known})


def _imageless(stamp_ns: int) -> Frame:
    """A frame of which only the stamp is ever read."""
    return Frame(stamp_ns, np.zeros((1, 1, 3), dtype=np.uint8), Camera(np.eye(3), 1, 1))


def save_result(path: str | os.PathLike[str], result: TemporalResult) -> None:
    """Write the result as ``.npz``, whole or not at all.

    Raises:
        InputError: the folder does not exist or cannot be written.
    """
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            np.savez(file, **vars(result))
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
