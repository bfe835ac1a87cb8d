"""The methods that answer frame by frame; see :mod:`hat_ros.bench.methods.modes`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hat_ros.array_types import Float
from hat_ros.config import HatConfig
from hat_ros.hypotheses.stage import HypothesisStage
from hat_ros.motion.stage import MotionStage
from hat_ros.refinement.contour_refiner import ContourRefiner
from hat_ros.segmentation.stage import SegmentationStage
from hat_ros.stages import PoseRefiner
from hat_ros.target.model import Target
from hat_ros.tracker import HatTracker, StageWrapper, Step
from hat_ros.types import Candidates, Detection, Estimate, Frame, Motion, Refined, Selection, TrackState

_NO_POSE = np.full(7, np.nan)
_NO_COVARIANCE = np.full((6, 6), np.nan)


class Hat:
    """The method of the paper, as :class:`HatTracker` runs it."""

    causal = True
    concurrent = True

    def __init__(self, config: HatConfig, target: Target, wrap: StageWrapper) -> None:
        self._tracker = HatTracker(config, target, wrap)

    def step(self, frame: Frame) -> Step:
        """See :meth:`HatTracker.step`."""
        return self._tracker.step(frame)

    @property
    def hypotheses(self) -> HypothesisStage:
        """Stage 2 of the tracker."""
        return self._tracker.hypotheses

    def finish(self) -> list[Estimate]:
        """Nothing: HAT never revises."""
        return []


class Independent:
    """Every frame for itself: its best-scored hypothesis that is a pose at all, without the guard (as published)."""

    causal = True
    concurrent = True

    def __init__(self, config: HatConfig, target: Target, wrap: StageWrapper) -> None:
        config = replace(
            config,
            keyframes=replace(config.keyframes, gap_frames=1),
            hypotheses=replace(config.hypotheses, guard=False),
        )
        self._segmentation = wrap("segmentation", SegmentationStage(config, target))
        self._hypotheses = wrap("hypotheses", HypothesisStage(config, target))

    def step(self, frame: Frame) -> Step:
        """One image, one answer."""
        detection = self._segmentation.update(frame, None)
        candidates = self._hypotheses.update(frame, detection, None)
        return _step(detection, candidates, _best_appearance(frame, candidates))

    def finish(self) -> list[Estimate]:
        """Nothing: every answer is final."""
        return []


class Tracking:
    """The previous pose, refined on each image; the best appearance where there is no track to follow.

    Refined by the hypothesis backend's own refiner where it has one (the paper's "MegaPose tracking"), else on its
    contour.
    """

    causal = True
    concurrent = False  # a step follows the pose of the one before

    def __init__(self, config: HatConfig, target: Target, wrap: StageWrapper) -> None:
        config = replace(
            config,
            keyframes=replace(config.keyframes, gap_frames=1),
            refinement=replace(config.refinement, enabled=True),
        )
        self._segmentation = wrap("segmentation", SegmentationStage(config, target))
        hypotheses = HypothesisStage(config, target)
        self._hypotheses = wrap("hypotheses", hypotheses)
        refiner = hypotheses.refiner or ContourRefiner(config.refinement, target)
        self._refinement = wrap("fusion", _LastPose(refiner))

    def step(self, frame: Frame) -> Step:
        """Follow, or start afresh."""
        detection = self._segmentation.update(frame, None)
        refined = self._refinement.update(frame, detection)
        if refined is not None:
            estimate = Estimate(frame.stamp_ns, TrackState.TRACKING, refined.pose_row, refined.covariance)
            return _step(detection, Candidates.none(), estimate)
        candidates = self._hypotheses.update(frame, detection, None)
        estimate = _best_appearance(frame, candidates)
        self._refinement.start(estimate)
        return _step(detection, candidates, estimate)

    def finish(self) -> list[Estimate]:
        """Nothing: every answer is final."""
        return []


class _LastPose:
    """The track of :class:`Tracking`."""

    def __init__(self, refiner: PoseRefiner) -> None:
        self._refiner = refiner
        self._T_cam_target: Float | None = None

    def start(self, estimate: Estimate) -> None:
        """Follow this pose from the next frame on."""
        self._T_cam_target = estimate.T_cam_target if estimate.state.has_pose else None

    def update(self, frame: Frame, detection: Detection | None) -> Refined | None:
        """The last pose refined on this image; None when there is no track or it is lost here."""
        if self._T_cam_target is None:
            return None
        refined = self._refiner.refine(frame, detection, self._T_cam_target)
        self._T_cam_target = None if refined is None else refined.T_cam_target
        return refined


class Observe:
    """The front ends alone: candidates at every frame, motion, no priors and no pose."""

    causal = True
    concurrent = True

    def __init__(self, config: HatConfig, target: Target, wrap: StageWrapper) -> None:
        config = replace(config, keyframes=replace(config.keyframes, gap_frames=1))
        self._segmentation = wrap("segmentation", SegmentationStage(config, target))
        self._hypotheses = wrap("hypotheses", HypothesisStage(config, target))
        self._motion = wrap("motion", MotionStage(config, target))

    def step(self, frame: Frame) -> Step:
        """Observe one image; no pose."""
        detection = self._segmentation.update(frame, None)
        motion = self._motion.update(frame, detection, None)
        candidates = self._hypotheses.update(frame, detection, None)
        nothing = Estimate(
            frame.stamp_ns,
            TrackState.UNINITIALISED,
            _NO_POSE,
            _NO_COVARIANCE,
            keyframe=len(candidates) > 0,
            n_candidates=len(candidates),
            slam_epoch=motion.epoch,
        )
        return Step(detection, candidates, motion, Selection.none(), nothing)

    def finish(self) -> list[Estimate]:
        """Nothing."""
        return []


def _best_appearance(frame: Frame, candidates: Candidates) -> Estimate:
    found = len(candidates) > 0 and bool(np.isfinite(candidates.log_score[0]))
    return Estimate(
        frame.stamp_ns,
        TrackState.TRACKING if found else TrackState.LOST,
        candidates.pose_rows[0] if found else _NO_POSE,
        _NO_COVARIANCE,
        keyframe=len(candidates) > 0,
        n_candidates=len(candidates),
        anchor=0 if found else -1,
    )


def _step(detection: Detection | None, candidates: Candidates, estimate: Estimate) -> Step:
    return Step(detection, candidates, Motion.none(), Selection.none(), estimate)
