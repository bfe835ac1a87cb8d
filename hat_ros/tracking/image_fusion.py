"""Stage 4 with image measurements: every output is refined on its own image, causally. Our extension of the paper.

The paper refines offline and lets SLAM and anchors alone carry the causal pose. Here each frame's prediction (relative
motion applied to the previous output) is refined on that frame's own image, and an accepted refinement is a measurement
like an anchor: it becomes the output, and with it the previous output of the next frame. What the image does not show
of the rotation stays as predicted, as far as the recent predictions deserve it (:mod:`hat_ros.tracking.attitude`).

At keyframes the selected anchor competes with the track:

* Within D of the track it is one basin, and the anchor one more start for the refinement: the best result wins.
* Beyond D it stands in a competing basin. Successive anchors in it that follow from each other (the paper's
  coherence) add up, and so does their lead in image evidence over the track. The competing basin takes over once it is
  supported, leads by ``arbitration_margin`` and, if anchors support the track, is the decoder's clear choice; or once
  more coherent anchors support it than clear ones support the track, the first one included (``reset_anchors`` at most,
  as in the paper), unless the image evidence is against it by that margin. This is the hysteresis of the track.

With no refinement supported, the output is what the paper's fusion makes of prediction and anchor, and it coasts. A
supported output is called TRACKING only if its basin is certain as well (:mod:`hat_ros.tracking.confidence`): the
image is certain, or a second anchor confirmed the track's prediction, or the decoder's lead is large; some image so far
was explained well, or three anchors confirmed the prediction; and no two anchors in a row have disagreed since.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np

from hat_ros.array_types import Float
from hat_ros.config import HatConfig, RefinementConfig
from hat_ros.core.alignment import SlamAlignment
from hat_ros.core.cadence import Cadence
from hat_ros.core.published_fusion import AreaConfidence, Dissent, Fused, fuse_two, relative_motion
from hat_ros.core.selector import box_area_px
from hat_ros.geometry import lie
from hat_ros.stages import PoseRefiner
from hat_ros.tracking.attitude import AttitudeFilter
from hat_ros.tracking.confidence import BasinConfidence
from hat_ros.tracking.prior import extrapolate
from hat_ros.tracking.uncertainty import KeyframeSpread, widened
from hat_ros.types import Detection, Frame, Motion, Refined, RotationPrior, Selection, StateReason

# An anchor within this share of D confirms the prediction; further off it shares the basin, and confirms nothing.
_CLOSE_SHARE = 0.5
# A wrong pose hardly ever explains an image well, and its lead among other poor ones means little: a track whose
# evidence never came this far needs so many confirmations, since masks err alike at successive keyframes.
_EXPLAINED_QUALITY, _CONFIRMATIONS = 0.83, 3
# So many frames left out in a row carry a target out of its basin: what supported the track before is void.
_INTERRUPTION_FRAMES = 5
# Measured outputs behind the constant-rate prediction.
_RATE_HISTORY = 6


@dataclass
class _TrackSupport:
    """What supports the basin of the present track.

    Attributes:
        best_quality: of its refinements so far.
        confirmed: the image is certain of the basin, or an anchor has confirmed a prediction.
        clear_start: it started from an anchor that was the decoder's clear choice.
        n_confirmations: clear anchors close to their prediction since; one that is not close starts the count anew.
        n_disagreements: anchors outside the basin since the last one inside.
    """

    best_quality: float = 0.0
    confirmed: bool = False
    clear_start: bool = False
    n_confirmations: int = 0
    n_disagreements: int = 0

    @property
    def n_anchors(self) -> int:
        """Clear anchors behind the track; none counts while no image has supported it."""
        return self.n_confirmations + self.clear_start if self.best_quality > 0.0 else 0

    def verdict(self) -> StateReason:
        """CONFIRMED unless the track itself is in doubt."""
        if self.n_disagreements > 1:
            return StateReason.CONTRADICTED
        explained = self.best_quality >= _EXPLAINED_QUALITY or self.n_confirmations >= _CONFIRMATIONS
        return StateReason.CONFIRMED if explained else StateReason.UNEXPLAINED


class ImageFusion:
    """Track, anchors and image evidence, frame by frame.

    Attributes:
        alignment: the Sim(3), fitted to measured outputs at keyframes.
    """

    def __init__(self, config: HatConfig, refiner: PoseRefiner) -> None:
        self._fusion, self._refinement = config.fusion, config.refinement
        self._alignment_config = config.alignment
        self._refiner = refiner
        self.reset()

    def reset(self) -> None:
        """Forget the target's state; the next anchor starts afresh."""
        self._refiner.reset()
        self.alignment = SlamAlignment(self._alignment_config)
        self._area_confidence = AreaConfidence(self._fusion)
        self._confidence = BasinConfidence(self._refinement, self._fusion.gate_angle_deg)
        self._spread = KeyframeSpread(self._fusion.gate_angle_deg)
        self._dissent = Dissent(self._fusion.gate_angle_deg, self._alignment_config.reset_anchors)
        self._attitude = AttitudeFilter(np.radians(self._refinement.start_sigma_deg))
        self._cadence = Cadence()
        self._lead = 0.0
        self._epoch = 0
        self.lose()

    def lose(self) -> None:
        """Give the track up: the next supported anchor starts afresh."""
        self._output: tuple[Float, Motion] | None = None
        self._start_track()
        self._measured: deque[tuple[int, Float]] = deque(maxlen=_RATE_HISTORY)
        self._just_measured = False

    def _start_track(self) -> None:
        """Nothing supports or contradicts the track yet, and nothing is known of its predictions."""
        self._attitude.forget()
        self._held: Refined | None = None
        self._support = _TrackSupport()
        self._forget_competitors()

    def update(self, frame: Frame, detection: Detection | None, motion: Motion, selection: Selection) -> Fused:
        """Advance by one frame. See :class:`~hat_ros.core.fusion.FusionMethod`."""
        anchor, confidence, decided = selection.anchor, 1.0, False
        if anchor is not None:
            confidence = self._area_confidence.update(box_area_px(selection.candidates.box_xyxy))
            # An anchor with a small margin supports no track, nor does it alone replace one.
            decided = self._confidence.decides(selection, anchor)
        fused = self._advance(frame, detection, motion, anchor, confidence, decided)
        self._confidence.update(selection, fused.T_cam_target)
        if fused.reason != StateReason.CONFIRMED:
            return fused
        return replace(fused, reason=self._confidence.verdict(self._support.confirmed))

    def spread(self, selection: Selection, T_cam_target: Float) -> Float:
        """(6, 6) spread of the hypotheses about the output over the last keyframes (:class:`KeyframeSpread`)."""
        return self._spread.update(selection, T_cam_target)

    def _advance(
        self,
        frame: Frame,
        detection: Detection | None,
        motion: Motion,
        anchor: Float | None,
        confidence: float,
        decided: bool,
    ) -> Fused:
        if motion.epoch != self._epoch:
            self._epoch = motion.epoch
            self.alignment.reset()
        if self._cadence.missed(frame.stamp_ns) >= _INTERRUPTION_FRAMES:
            self._start_track()
        if self._output is None:
            fused = self._start(frame, detection, anchor, decided)
        else:
            predictions = self._predictions(frame.stamp_ns, motion, *self._output)
            fused = self._decide(frame, detection, predictions, anchor, confidence, decided)
        if fused.reset:
            self.alignment.reset()
        if fused.measurement is not None:
            if self._jumps(fused.measurement, fused.predicted):
                self._measured.clear()
            self._measured.append((frame.stamp_ns, fused.measurement))
            if anchor is not None and motion.valid:
                self.alignment.observe(fused.measurement, motion.T_slam_cam)
        self._just_measured = fused.measurement is not None
        self.alignment.update(motion.epoch)
        self._output = None if fused.T_cam_target is None else (fused.T_cam_target, motion)
        return fused

    def _decide(
        self,
        frame: Frame,
        detection: Detection | None,
        predictions: list[Float],
        anchor: Float | None,
        confidence: float,
        decided: bool,
    ) -> Fused:
        predicted = predictions[0]
        self._held = self._refiner.refine(frame, detection, predicted, self._rotation_prior(predicted))
        track = self._best_refined(frame, detection, predictions[1:], self._held, self._refinement.switch_margin)
        if anchor is None:
            return self._outcome(track, predicted, predicted)
        reference = track.T_cam_target if is_supported(track, self._refinement) else predicted
        if not self._dissent.update(anchor, reference):
            self._forget_competitors()
            apart_rad = lie.angle_between(anchor[:3, :3], predicted[:3, :3])
            close = apart_rad <= np.radians(_CLOSE_SHARE * self._fusion.gate_angle_deg)
            self._support.n_confirmations = self._support.n_confirmations + decided if close else 0
            self._support.n_disagreements = 0
            return self._agree(frame, detection, track, predicted, anchor, confidence)
        return self._arbitrate(frame, detection, track, predicted, anchor, decided)

    def _start(self, frame: Frame, detection: Detection | None, anchor: Float | None, decided: bool) -> Fused:
        """Without a track the anchor starts one; unless the image supports it, it only coasts."""
        if anchor is None:
            return Fused(None)
        self._support.clear_start = decided
        refined = self._best_refined(frame, detection, [anchor])
        return replace(self._outcome(refined, anchor, None), gate_weight=1.0)

    def _agree(
        self,
        frame: Frame,
        detection: Detection | None,
        track: Refined | None,
        predicted: Float,
        anchor: Float,
        confidence: float,
    ) -> Fused:
        """Anchor and track share a basin: the better refinement; unsupported, the paper's fusion of the two.

        An unsupported anchor with less evidence than the track does not pull at it.
        """
        best = self._best_refined(frame, detection, [anchor], track)
        otherwise = predicted
        if track is None or best is not track:
            otherwise = fuse_two(anchor, confidence, predicted, self._fusion, self._alignment_config.lever_m_per_rad)
        return replace(self._outcome(best, otherwise, predicted), gate_weight=1.0)

    def _arbitrate(
        self,
        frame: Frame,
        detection: Detection | None,
        track: Refined | None,
        predicted: Float,
        anchor: Float,
        decided: bool,
    ) -> Fused:
        """Anchor and track stand in different basins: weigh the evidence so far.

        Against a track that other anchors support, one with a small margin is not enough, however much the mask,
        which both were compared with, prefers it. Anchors that agree on what no image has ever supported do not count.
        """
        self._support.n_disagreements += 1
        competitor = self._best_refined(frame, detection, [anchor])
        lead = quality(competitor) - quality(track)
        self._lead = lead if self._dissent.count == 1 else self._lead + lead
        n_anchors = self._support.n_anchors
        needed = min(n_anchors + 1, self._alignment_config.reset_anchors)
        margin = self._refinement.arbitration_margin
        clearly_better = self._lead >= margin and is_supported(competitor, self._refinement)
        clearly_better &= decided or n_anchors == 0
        outnumbers = self._dissent.count >= needed and self._lead > -margin
        if not (clearly_better or outnumbers):
            return replace(self._outcome(track, predicted, predicted), gate_weight=self._fusion.gate_weight)
        self._start_track()
        self._support.clear_start = decided
        return replace(self._outcome(competitor, anchor, None), gate_weight=1.0, reset=True)

    def _forget_competitors(self) -> None:
        self._dissent.clear()
        self._lead = 0.0

    def _rotation_prior(self, predicted: Float) -> RotationPrior | None:
        """What the track says of its rotation now; None without a track."""
        if self._output is None:
            return None
        output, _ = self._output
        return RotationPrior(predicted[:3, :3], self._attitude.predict(predicted[:3, :3] @ output[:3, :3].T))

    def _predictions(self, stamp_ns: int, motion: Motion, output: Float, previous: Motion) -> list[Float]:
        """Where the track should be now, best first, from its last output (4, 4) and the motion there.

        How the target turns relative motion knows from its second frame, how far it moves in metres only once it is
        aligned; until then the constant rate says it.
        """
        at_rate = self._at_constant_rate(stamp_ns)
        scale = 0.0 if self.alignment.current is None else self.alignment.current.scale
        step = relative_motion(previous, motion, scale)
        if step is None:
            return [output] if at_rate is None else [at_rate]
        if self.alignment.n_observations >= self._fusion.warmup_observations and scale > 0.0:
            position = (step @ output)[:3, 3]
        else:
            position = (output if at_rate is None else at_rate)[:3, 3]
        moved = lie.transform(step[:3, :3] @ output[:3, :3], position)
        # A rate that no image has confirmed of late is no second opinion.
        if at_rate is None or not self._just_measured or self._same(moved, at_rate):
            return [moved]
        return [moved, at_rate]

    def _at_constant_rate(self, stamp_ns: int) -> Float | None:
        """The measured outputs continued; None with fewer than two."""
        if len(self._measured) < 2:
            return None
        stamps, poses = zip(*self._measured, strict=True)
        return lie.matrix_from_row(extrapolate(np.array(stamps, dtype=np.int64), np.stack(poses), stamp_ns))

    def _best_refined(
        self,
        frame: Frame,
        detection: Detection | None,
        starts: list[Float],
        best: Refined | None = None,
        lead: float = 0.0,
    ) -> Refined | None:
        """The refinement with most evidence; a later start must lead by ``lead`` over a supported pose to replace it.

        Starts close to a supported pose are not tried: they would end there.
        """
        for start in starts:
            if is_supported(best, self._refinement) and self._same(start, best.T_cam_target):
                continue
            refined = self._refiner.refine(frame, detection, start)
            if quality(refined) > quality(best) + (lead if is_supported(best, self._refinement) else 0.0):
                best = refined
        return best

    def _same(self, T_a: Float, T_b: Float) -> bool:
        """Whether refinements that start at these poses would end at the same."""
        apart_rad = lie.angle_between(T_a[:3, :3], T_b[:3, :3])
        return bool(apart_rad <= np.radians(self._refinement.same_pose_deg))

    def _jumps(self, measurement: Float, predicted: Float | None) -> bool:
        """The measurement left the pose that the past predicted: earlier poses tell no rate."""
        if predicted is None:
            return True
        apart_rad = lie.angle_between(measurement[:3, :3], predicted[:3, :3])
        return bool(apart_rad > np.radians(2.0 * self._refinement.same_pose_deg))

    def _outcome(self, refined: Refined | None, otherwise: Float, predicted: Float | None) -> Fused:
        """A supported refinement as a measurement, which the track learns from, or another pose without one."""
        if not is_supported(refined, self._refinement):
            return Fused(otherwise, predicted)
        T = refined.T_cam_target
        if refined is self._held and predicted is not None:
            self._attitude.correct(T[:3, :3], predicted[:3, :3], refined.covariance[3:, 3:])
        else:
            self._attitude.restart(T[:3, :3], refined.covariance[3:, 3:])
        support = self._support
        support.best_quality = max(support.best_quality, quality(refined))
        # An unknown overlap (NaN) is never certain.
        sure = min(refined.overlap, refined.support) >= self._refinement.certain_share
        support.confirmed = sure or support.n_confirmations > 0
        return Fused(
            T,
            predicted,
            measurement=T,
            covariance=widened(refined.covariance, refined.misfit_px, self._basin(T)),
            reason=support.verdict(),
        )

    def _basin(self, T_cam_target: Float) -> Float:
        """(6,) sigmas, metres and radians: how far off a refinement in the right basin can be."""
        shift_m = self._refinement.max_shift * float(np.linalg.norm(T_cam_target[:3, 3]))
        return np.repeat([shift_m, np.radians(self._fusion.gate_angle_deg)], 3)


def is_supported(refined: Refined | None, config: RefinementConfig) -> TypeGuard[Refined]:
    """Whether the image supports a refined pose; without a silhouette mask the contour decides alone."""
    if refined is None:
        return False
    overlaps = np.isnan(refined.overlap) or refined.overlap >= config.min_overlap
    return bool(overlaps and refined.support >= config.min_support)


def quality(refined: Refined | None) -> float:
    """Image evidence for a pose, 0 for a refused one."""
    return 0.0 if refined is None else refined.quality
