"""The method on one page: one causal step per frame (paper, Fig. 1).

The five ROS nodes own one of these stages each; :class:`HatTracker` owns all five. Same objects, same order, same
inputs, so both give the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

from hat_ros.config import HatConfig
from hat_ros.core.fusion import FusionMethod, FusionStage
from hat_ros.core.published_fusion import PublishedFusion
from hat_ros.core.selector import SelectorStage
from hat_ros.hypotheses.stage import HypothesisStage
from hat_ros.motion.stage import MotionStage
from hat_ros.segmentation.stage import SegmentationStage
from hat_ros.target.exact_symmetry import symmetry_of
from hat_ros.target.model import Target
from hat_ros.tracking.prior import PriorBuffer
from hat_ros.types import Candidates, Detection, Estimate, Frame, Motion, Selection

Stage = TypeVar("Stage")


class StageWrapper(Protocol):
    """Gives the object that is called in a stage's place: how stages are scheduled and timed from outside."""

    def __call__(self, name: str, stage: Stage) -> Stage:
        """Wrap the stage of this name."""
        ...


@dataclass(frozen=True)
class Step:
    """Everything that the stages said about one frame."""

    detection: Detection | None
    candidates: Candidates
    motion: Motion
    selection: Selection
    estimate: Estimate


def unwrapped(name: str, stage: Stage) -> Stage:
    """The stage itself: the wrapper that does nothing."""
    return stage


class HatTracker:
    """Hypothesis-Anchored Tracking in one process.

    Args:
        config: the configuration of all stages.
        target: the CAD model, metric.
        wrap: called once for each stage with its name; what it returns is called in the stage's place.
    """

    def __init__(self, config: HatConfig, target: Target, wrap: StageWrapper = unwrapped) -> None:
        self.segmentation = wrap("segmentation", SegmentationStage(config, target))
        self.hypotheses = wrap("hypotheses", HypothesisStage(config, target))
        self.motion = wrap("motion", MotionStage(config, target))
        self.selector = wrap("selector", SelectorStage(config.selector))
        self.fusion = wrap("fusion", FusionStage(config, choose_fusion(config, target), symmetry_of(target)))
        self.priors = PriorBuffer(config.prior)

    def step(self, frame: Frame) -> Step:
        """Process one frame, stamps strictly increasing; nothing returned earlier is ever revised."""
        prior = self.priors.before(frame.stamp_ns)  # fused poses of frame t - delay and earlier
        detection = self.segmentation.update(frame, prior)  # Stage 1
        motion = self.motion.update(frame, detection, prior)  # target-relative SLAM
        candidates = self.hypotheses.update(frame, detection, prior)  # Stage 2, keyframes only; long, so after motion
        selection = self.selector.update(candidates, motion)  # Stage 3
        estimate = self.fusion.update(frame, detection, motion, selection)  # Stage 4
        self.priors.push(estimate)
        return Step(detection, candidates, motion, selection, estimate)

    def reset(self) -> None:
        """Forget the target's state; the next frame is treated like the first, in a new SLAM epoch."""
        for stage in (self.segmentation, self.hypotheses, self.motion, self.selector, self.fusion, self.priors):
            stage.reset()


def choose_fusion(config: HatConfig, target: Target) -> FusionMethod:
    """What solves for the pose in Stage 4.

    With ``refinement.enabled`` (the default preset) every pose is refined on its own image, and judged by it. Without
    (the paper's presets): the published fusion of anchors and relative motion.
    """
    if not config.refinement.enabled:
        return PublishedFusion(config)
    from hat_ros.refinement.contour_refiner import ContourRefiner  # OpenCV and compiled code: only where used
    from hat_ros.tracking.image_fusion import ImageFusion

    return ImageFusion(config, ContourRefiner(config.refinement, target))
