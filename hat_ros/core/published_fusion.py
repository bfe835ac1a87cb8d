"""Stage 4 as published: alignment, reset and zero-lag fusion, frame by frame; past outputs stay fixed.

Within a frame: a joint observation is stored, the alignment is (re)fitted when due, an anchor that contradicts it is
counted and may reset it, and then the pose is solved for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hat_ros.array_types import Float
from hat_ros.config import FusionConfig, HatConfig
from hat_ros.core.alignment import SlamAlignment
from hat_ros.core.inertia import InertialPrior
from hat_ros.core.pose_solver import PoseProblem, solve_pose
from hat_ros.core.selector import box_area_px
from hat_ros.geometry import lie
from hat_ros.types import Detection, Frame, Motion, Selection, StateReason


@dataclass(frozen=True)
class Fused:
    """What Stage 4 says about one frame.

    Attributes:
        T_cam_target: (4, 4), None when no output is possible.
        predicted: (4, 4) relative motion applied to the previous output, None without one.
        gate_weight: g at an anchor, NaN elsewhere.
        reset: the alignment was dropped at this frame.
        measurement: (4, 4) what this frame's own image measures, None when there is no measurement.
        covariance: (6, 6) of the measurement, None when its source does not know.
        reason: CONFIRMED if the output is to be called TRACKING, else why not.
    """

    T_cam_target: Float | None
    predicted: Float | None = None
    gate_weight: float = float("nan")
    reset: bool = False
    measurement: Float | None = None
    covariance: Float | None = None
    reason: StateReason = StateReason.NOT_MEASURED


class PublishedFusion:
    """Eqs. (alignmentfit) to (causalfusion) over a stream of frames.

    Attributes:
        alignment: the Sim(3) and its observations.
    """

    def __init__(self, config: HatConfig) -> None:
        self._alignment_config, self._config = config.alignment, config.fusion
        self._lever_m_per_rad = config.alignment.lever_m_per_rad
        self.reset()

    def reset(self) -> None:
        """Forget the target's state; the next anchor starts afresh."""
        fusion = self._config
        self.alignment = SlamAlignment(self._alignment_config)
        self._area_confidence = AreaConfidence(fusion)
        self._dissent = Dissent(fusion.gate_angle_deg, self._alignment_config.reset_anchors)
        self._inertia = InertialPrior(fusion.inertial_weight, fusion.relative_weight)
        self._epoch = 0
        self._previous: tuple[Float | None, Motion] = (None, Motion.none())

    def lose(self) -> None:
        """The output was given up. Nothing to do: alignment and previous output stay valid for the next anchor."""

    def update(self, frame: Frame, detection: Detection | None, motion: Motion, selection: Selection) -> Fused:
        """Advance by one frame; the image is not looked at. See :class:`~hat_ros.core.fusion.FusionMethod`."""
        anchor, confidence = selection.anchor, 1.0
        if anchor is not None:
            confidence = self._area_confidence.update(box_area_px(selection.candidates.box_xyxy))
        fused = self.advance(motion, anchor, confidence)
        return fused if fused.T_cam_target is None else replace(fused, reason=StateReason.CONFIRMED)

    def spread(self, selection: Selection, T_cam_target: Float) -> Float:
        """Zero (6, 6): here the anchors are the residuals, their spread is known already."""
        return np.zeros((6, 6))

    def advance(self, motion: Motion, anchor: Float | None, confidence: float) -> Fused:
        """Advance by one frame.

        Args:
            motion: target-relative camera state.
            anchor: (4, 4) selected ``T_cam_target``, None at frames without one.
            confidence: multiplies the anchor's residual.
        """
        self._enter_epoch(motion)
        if anchor is not None and motion.valid:
            self.alignment.observe(anchor, motion.T_slam_cam)
        self.alignment.update(motion.epoch)

        gate_weight, reset = (float("nan") if anchor is None else 1.0), False
        current = self.alignment.current
        if anchor is not None and motion.valid and current is not None:
            if self._dissent.update(anchor, current.target_in_camera(motion.T_slam_cam)):
                gate_weight = self._config.gate_weight
            if self._dissent.is_conclusive:
                gate_weight, reset = 1.0, True
                self._restart_from(anchor, motion)

        fused = self._fuse(motion, anchor, gate_weight, confidence)
        self._previous = (fused.T_cam_target, motion)
        return replace(fused, gate_weight=gate_weight, reset=reset, measurement=anchor)

    def _enter_epoch(self, motion: Motion) -> None:
        """A new SLAM epoch shares neither gauge nor scale with the old one: what was aligned is void."""
        if motion.epoch != self._epoch:
            self._epoch = motion.epoch
            self.alignment.reset()
            self._dissent.clear()

    def _restart_from(self, anchor: Float, motion: Motion) -> None:
        """The anchor that triggers a reset is fitted to, but the counts start at zero after it (authors' reference)."""
        self.alignment.reset()
        self.alignment.observe(anchor, motion.T_slam_cam, counts=False)
        self._dissent.clear()

    def _fuse(self, motion: Motion, anchor: Float | None, gate_weight: float, confidence: float) -> Fused:
        current, config = self.alignment.current, self._config
        if current is None or self.alignment.n_observations < config.warmup_observations:
            return Fused(anchor)
        predicted = self._predict(motion, current.scale)
        if predicted is None:
            # Without a relative residual the minimum is the anchor itself; without either, the aligned SLAM pose.
            alone = current.target_in_camera(motion.T_slam_cam) if anchor is None and motion.valid else anchor
            return Fused(alone)
        if anchor is None:
            return Fused(predicted, predicted)
        fused = fuse_two(anchor, gate_weight * confidence, predicted, config, self._lever_m_per_rad)
        return Fused(fused, predicted)

    def _predict(self, motion: Motion, scale: float) -> Float | None:
        """Delta S applied to the previous frame's output; None unless that and both SLAM poses exist."""
        output, previous = self._previous
        step = relative_motion(previous, motion, scale)
        if output is None or step is None:
            self._inertia.forget()
            return None
        return self._inertia.smooth(output, step @ output)


class Dissent:
    """Counts successive anchors that contradict the aligned rotation yet agree with each other.

    An agreeing anchor clears the count, one that does not follow from the previous dissenter restarts it at one.

    Attributes:
        count: coherent dissenters in a row, the last anchor included.
    """

    def __init__(self, gate_angle_deg: float, n_conclusive: int) -> None:
        self._gate_rad = np.radians(gate_angle_deg)
        self._n_conclusive = n_conclusive
        self.clear()

    def clear(self) -> None:
        """Forget all dissenting anchors."""
        self.count = 0
        self._previous: tuple[Float, Float] | None = None

    @property
    def is_conclusive(self) -> bool:
        """Enough coherent dissenters in a row."""
        return self.count >= self._n_conclusive

    def update(self, anchor: Float, aligned: Float) -> bool:
        """Count one anchor against the aligned SLAM pose of its frame, (4, 4) each; True when it disagrees."""
        R_anchor, R_aligned = anchor[:3, :3], aligned[:3, :3]
        if lie.angle_between(R_anchor, R_aligned) <= self._gate_rad:
            self.clear()
            return False
        coherent = False
        if self._previous is not None:
            R_previous_anchor, R_previous_aligned = self._previous
            propagated = R_aligned @ R_previous_aligned.T @ R_previous_anchor
            coherent = bool(lie.angle_between(R_anchor, propagated) <= self._gate_rad)
        self.count = self.count + 1 if coherent else 1
        self._previous = (R_anchor, R_aligned)
        return True


class AreaConfidence:
    """Detection-area confidence of the SPARK-tuned Mega-HAT: larger targets give better anchors.

    The area over its running mean, to a power, renormalised by that quantity's own running mean (both means include
    the current anchor), so that it averages one. Running sums only.
    """

    def __init__(self, config: FusionConfig) -> None:
        self._config = config
        self._n, self._area_sum, self._relative_sum = 0, 0.0, 0.0

    def update(self, area_px: float) -> float:
        """Confidence of an anchor whose detection box covers ``area_px``; 1 when uniform or unknown."""
        if self._config.confidence == "uniform" or not area_px > 0:
            return 1.0
        self._n += 1
        self._area_sum += area_px
        relative = (area_px * self._n / self._area_sum) ** self._config.confidence_exponent
        self._relative_sum += relative
        return relative * self._n / self._relative_sum


def fuse_two(
    anchor: Float, anchor_weight: float, predicted: Float, config: FusionConfig, lever_m_per_rad: float
) -> Float:
    """The pose between an anchor and a prediction, eq. (causalfusion): (4, 4)."""
    if anchor_weight == 0.0:
        return predicted
    if config.relative_weight == 0.0:
        return anchor
    problem = PoseProblem(
        anchor=anchor,
        anchor_weight=anchor_weight,
        predicted=predicted,
        relative_weight=config.relative_weight,
        lever_m_per_rad=lever_m_per_rad,
        huber_delta_m=config.huber_delta_m if config.loss == "huber" else None,
    )
    return solve_pose(problem)


def relative_motion(previous: Motion, current: Motion, scale: float) -> Float | None:
    """Delta S = S_i S_{i-1}^-1 in metres: (4, 4), or None when a pose is missing or the epochs differ.

    The alignment's rotation and translation cancel: Delta S = (R_i^T R_{i-1}, s R_i^T (t_{i-1} - t_i)).
    """
    if not (previous.valid and current.valid) or previous.epoch != current.epoch:
        return None
    T_now, T_before = current.T_slam_cam, previous.T_slam_cam
    R_T = T_now[:3, :3].T
    return lie.transform(R_T @ T_before[:3, :3], scale * (R_T @ (T_before[:3, 3] - T_now[:3, 3])))
