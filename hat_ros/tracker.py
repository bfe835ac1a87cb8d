"""The method on one page: one causal step per frame (paper, Fig. 1; DESIGN section 3).

The five ROS nodes own one of these stages each; :class:`HatTracker` owns all five. Same objects, same order, same
inputs, so both give the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass

from hat_ros.config import HatConfig
from hat_ros.core.fusion import FusionStage
from hat_ros.core.selector import SelectorStage
from hat_ros.hypotheses.stage import HypothesisStage
from hat_ros.motion.stage import MotionStage
from hat_ros.refinement import create_refiner
from hat_ros.segmentation.stage import SegmentationStage
from hat_ros.target.model import Target
from hat_ros.tracking.prior import PriorBuffer
from hat_ros.types import Candidates, Detection, Estimate, Frame, Motion, Selection


@dataclass(frozen=True)
class Step:
    """Everything that the stages said about one frame."""

    detection: Detection | None
    candidates: Candidates
    motion: Motion
    selection: Selection
    estimate: Estimate


class HatTracker:
    """Hypothesis-Anchored Tracking in one process.

    Args:
        config: the configuration of all stages.
        target: the CAD model, metric.
    """

    def __init__(self, config: HatConfig, target: Target) -> None:
        self.segmentation = SegmentationStage(config, target)
        self.hypotheses = HypothesisStage(config, target)
        self.motion = MotionStage(config, target)
        self.selector = SelectorStage(config.selector)
        self.fusion = FusionStage(config, create_refiner(config, target))
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
