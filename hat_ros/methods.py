"""Other ways to turn the same front ends into poses, to compare HAT with.

* ``independent``: hypotheses at every frame; the best appearance is the output. No memory.
* ``tracking``: refine the previous pose on each image; the best appearance only to (re-)start. No decoder, no fusion.
* ``offline``: HAT's observations, then a backtrace and one joint optimisation of all frames, and dense refinement where
  the configuration refines. Not causal: a reference.
* ``srt3d``: the region tracker of :mod:`hat_ros.evaluation.srt3d`, started by the best appearance, never again.
* ``observe``: the front ends alone, candidates at every frame and no output: what temporal sweeps run on.

Each offers what :class:`~hat_ros.tracker.HatTracker` offers, so the pipeline runs them all alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np

from hat_ros import lie
from hat_ros.config import HatConfig
from hat_ros.core.offline import solve_offline
from hat_ros.core.refined import is_supported, quality
from hat_ros.core.refiner import Refiner
from hat_ros.errors import UsageError
from hat_ros.evaluation.srt3d import Srt3d
from hat_ros.hypotheses.stage import HypothesisStage
from hat_ros.refinement import create_refiner
from hat_ros.segmentation.stage import SegmentationStage
from hat_ros.slam.stage import MotionStage
from hat_ros.target import Target
from hat_ros.tracker import HatTracker, Step
from hat_ros.types import Camera, Candidates, Detection, Estimate, Frame, Motion, Refined, Selection, TrackState

MODES = ("hat", "independent", "tracking", "offline", "srt3d", "observe")

# The paper's dense refinement rejects what lies further than this from the anchors.
_SAME_BASIN_DEG = 90.0
_NO_POSE = np.full(7, np.nan)
_NO_COVARIANCE = np.full((6, 6), np.nan)


class Method(Protocol):
    """What turns frames into poses."""

    causal: bool
    """Whether ``step`` gives the final answer; if not, :meth:`finish` does."""

    concurrent: bool
    """Whether steps of several frames may overlap by the rules of :mod:`hat_ros.turnstile`."""

    stages: dict[str, Any]
    """Stage name -> the object whose ``update`` is that stage; for timing."""

    def step(self, frame: Frame) -> Step:
        """Process one frame, stamps strictly increasing."""
        ...

    def finish(self) -> list[Estimate]:
        """The estimates of all frames, for a method that is not causal; empty otherwise."""
        ...


def create_method(mode: str, config: HatConfig, target: Target) -> Method:
    """Build the method that ``--mode`` names.

    Raises:
        UsageError: unknown mode.
        ConfigError: the configuration names an unknown backend.
    """
    methods = {
        "hat": Hat,
        "independent": Independent,
        "tracking": Tracking,
        "offline": Offline,
        "srt3d": Srt3d,
        "observe": Observe,
    }
    if mode not in methods:
        raise UsageError(f"mode '{mode}' is unknown, choose one of {', '.join(MODES)}")
    return methods[mode](config, target)


class Hat:
    """The method of the paper, as :class:`HatTracker` runs it."""

    causal = True
    concurrent = True

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._tracker = HatTracker(config, target)
        self.stages = {
            name: getattr(self._tracker, name)
            for name in ("segmentation", "hypotheses", "motion", "selector", "fusion")
        }

    def step(self, frame: Frame) -> Step:
        """See :meth:`HatTracker.step`."""
        return self._tracker.step(frame)

    def finish(self) -> list[Estimate]:
        """Nothing: HAT never revises."""
        return []


class Independent:
    """Every frame for itself: its best-scored hypothesis, or no pose."""

    causal = True
    concurrent = True

    def __init__(self, config: HatConfig, target: Target) -> None:
        config = replace(config, keyframes=replace(config.keyframes, gap_frames=1))
        self._segmentation = SegmentationStage(config, target)
        self._hypotheses = HypothesisStage(config, target)
        self.stages = {"segmentation": self._segmentation, "hypotheses": self._hypotheses}

    def step(self, frame: Frame) -> Step:
        """One image, one answer."""
        detection = self._segmentation.update(frame, None)
        candidates = self._hypotheses.update(frame, detection, None)
        return _step(detection, candidates, _best_appearance(frame, candidates))

    def finish(self) -> list[Estimate]:
        """Nothing: every answer is final."""
        return []


class Tracking:
    """The previous pose, refined on each image; the best appearance where there is no track to follow."""

    causal = True
    concurrent = False  # a step follows the pose of the one before

    def __init__(self, config: HatConfig, target: Target) -> None:
        config = replace(
            config,
            keyframes=replace(config.keyframes, gap_frames=1),
            refinement=replace(config.refinement, enabled=True),
        )
        self._segmentation = SegmentationStage(config, target)
        self._hypotheses = HypothesisStage(config, target)
        self._refinement = _LastPose(create_refiner(config, target))
        self.stages = {
            "segmentation": self._segmentation,
            "hypotheses": self._hypotheses,
            "fusion": self._refinement,
        }

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

    def __init__(self, refiner: Refiner) -> None:
        self._refiner = refiner
        self._T_cam_target: np.ndarray | None = None

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
    """What the front ends see when nobody asks for a pose: candidates at every frame, motion, no priors."""

    causal = True
    concurrent = True

    def __init__(self, config: HatConfig, target: Target) -> None:
        config = replace(config, keyframes=replace(config.keyframes, gap_frames=1))
        self._segmentation = SegmentationStage(config, target)
        self._hypotheses = HypothesisStage(config, target)
        self._motion = MotionStage(config, target)
        self.stages = {"segmentation": self._segmentation, "hypotheses": self._hypotheses, "motion": self._motion}

    def step(self, frame: Frame) -> Step:
        """Look, and say nothing."""
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


class Offline:
    """What hindsight makes of the observations of HAT (paper, "Causal and Offline Performance Comparison")."""

    causal = False
    concurrent = False

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._config = config
        self._hat = Hat(config, target)
        self._refiner = create_refiner(config, target)
        self._steps: list[Step] = []
        self._images: list[_StoredImage] = []
        self.stages = self._hat.stages

    def step(self, frame: Frame) -> Step:
        """Observe; the estimate in the returned step is the causal one."""
        step = self._hat.step(frame)
        self._steps.append(replace(step, detection=None))
        if self._refiner is not None:
            self._images.append(_StoredImage.of(frame, step.detection))
        return step

    def finish(self) -> list[Estimate]:
        """Decode, align, optimise jointly; refine on the images."""
        steps = self._steps
        if not steps:
            return []
        result = solve_offline([step.candidates for step in steps], [step.motion for step in steps], self._config)
        rows = lie.row_from_matrix(np.where(np.isfinite(result.T_cam_target), result.T_cam_target, np.eye(4)))
        rows[~np.isfinite(result.T_cam_target).all(axis=(1, 2))] = np.nan
        estimates = []
        for index, step in enumerate(steps):
            row, covariance = self._refined(index, rows[index])
            state = TrackState.TRACKING if np.isfinite(row).all() else TrackState.LOST
            decided = {"anchor": int(result.chosen[index]), "gate_weight": float(result.gate_weight[index])}
            estimates.append(
                replace(step.estimate, state=state, pose_row=row, covariance=covariance, gap_frames=0, **decided)
            )
        return estimates

    def _refined(self, index: int, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A pose refined on its image; from the causal pose where that stands elsewhere and the image prefers it."""
        if self._refiner is None or not np.isfinite(row).all():
            return row, _NO_COVARIANCE
        frame, detection = self._images[index].load()
        config, T_cam_target = self._config.refinement, lie.matrix_from_row(row)
        best = self._refiner.refine(frame, detection, T_cam_target)
        causal = self._steps[index].estimate
        if causal.state.has_pose:
            known = T_cam_target if best is None else best.T_cam_target
            apart_deg = np.degrees(lie.angle_between(causal.T_cam_target[:3, :3], known[:3, :3]))
            # Like the paper's dense refinement, which never leaves the basin of the anchors.
            if config.same_pose_deg < apart_deg < _SAME_BASIN_DEG:
                other = self._refiner.refine(frame, detection, causal.T_cam_target)
                if quality(other) > quality(best) + (config.switch_margin if is_supported(best, config) else 0.0):
                    best = other
        if not is_supported(best, config):
            return row, _NO_COVARIANCE
        return best.pose_row, best.covariance


@dataclass(frozen=True)
class _StoredImage:
    """A frame and its detection, compressed without loss."""

    stamp_ns: int
    camera: Camera
    png: np.ndarray
    mask_bits: np.ndarray | None
    silhouette: bool

    @classmethod
    def of(cls, frame: Frame, detection: Detection | None) -> _StoredImage:
        png = cv2.imencode(".png", frame.rgb, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        bits = None if detection is None else np.packbits(detection.mask)
        return cls(frame.stamp_ns, frame.camera, png, bits, detection is not None and detection.silhouette)

    def load(self) -> tuple[Frame, Detection | None]:
        frame = Frame(self.stamp_ns, cv2.imdecode(self.png, cv2.IMREAD_COLOR), self.camera)
        if self.mask_bits is None:
            return frame, None
        shape = (self.camera.height, self.camera.width)
        mask = np.unpackbits(self.mask_bits, count=shape[0] * shape[1]).reshape(shape).astype(bool)
        return frame, Detection(mask, self.silhouette)


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
