"""Stage 2 as the tracker and the node see it: one backend, called at keyframes only, its candidates checked."""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Float
from hat_ros.config import HatConfig
from hat_ros.core.cadence import Cadence
from hat_ros.core.guard import guard_candidates
from hat_ros.core.initial_pose import Acquisition, InitialPose
from hat_ros.core.keyframes import KeyframeSchedule
from hat_ros.segmentation.annotated import pad_box
from hat_ros.stages import PoseRefiner, create_backend
from hat_ros.target.exact_symmetry import symmetry_of
from hat_ros.target.model import Target
from hat_ros.types import Candidates, Detection, Frame, PosePrior

# Between successive detections of one thing little changes: boxes overlap by this, intersection over union, and
# neither mask has less than this share of the other's area.
_SAME_BOX_OVERLAP = 0.5
_SAME_AREA_SHARE = 0.8


class HypothesisStage:
    """Generates candidates at anchor opportunities (paper, Stage 2).

    Args:
        config: the whole configuration; ``hypotheses.backend`` names the backend.
        target: the CAD model.
    """

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._max_candidates = config.hypotheses.max_candidates
        self._drop_implausible = config.hypotheses.guard
        self._region = config.segmentation
        self._schedule = KeyframeSchedule(config.keyframes)
        self._cadence = Cadence()
        self._apart_deg, self._min_lead = config.fusion.gate_angle_deg, config.refinement.min_margin
        self._backend = create_backend("hypotheses", config, target)
        self._symmetry = symmetry_of(target)
        self._acquisition = Acquisition(config)
        self._R_reference: Float | None = None
        self._newest: Detection | None = None
        self._changed = False

    def update(
        self, frame: Frame, detection: Detection | None, prior: PosePrior | None, given: InitialPose | None = None
    ) -> Candidates:
        """Candidates of one frame, best first; zero rows between keyframes and without a detection.

        What navigation says of the target is ``given`` with the frame from which on it is in force.

        Raises:
            CandidateError: the backend returned a score or pose that is not finite and ``hypotheses.guard`` is off.
        """
        initial = self._acquisition.at(prior, given)
        # A body of revolution turns under outlines and light that stay: its track is held against images alone often.
        healthy = prior is not None and prior.healthy and not len(self._symmetry.axes)
        self._observe(detection)
        failed = self._changed and (prior is None or not prior.supported)
        n_missed = self._cadence.missed(frame.stamp_ns)
        if not self._schedule.update(detection is not None, healthy, failed, n_missed) or detection is None:
            return Candidates.none()
        self._changed = False
        candidates = self._one_of_equals(self.generate(frame, detection, prior, initial), prior)
        if len(candidates):
            self._acquisition.found()
        self._schedule.answered(decided=candidates.lead(self._apart_deg) >= self._min_lead)
        return candidates

    def generate(
        self, frame: Frame, detection: Detection, prior: PosePrior | None, initial: InitialPose | None = None
    ) -> Candidates:
        """Candidates of one image, whether it is a keyframe or not; arguments and errors as for :meth:`update`.

        Of a target that is sought with an initial pose, those alone that agree with it.
        """
        if initial is not None:
            prior = initial.as_start(frame.stamp_ns)
        candidates = self._backend.generate(frame, self._seen(detection), prior)
        if initial is not None:
            candidates = initial.keep(candidates.nearest(self._symmetry, initial.R_cam_target))
        return guard_candidates(candidates.first(self._max_candidates), self._drop_implausible)

    @property
    def refiner(self) -> PoseRefiner | None:
        """What the backend refines poses with, None when it has nothing of its own."""
        return self._backend if isinstance(self._backend, PoseRefiner) else None

    def reset(self) -> None:
        """Forget earlier frames; the next frame with a detection is a keyframe."""
        self._schedule.reset()
        self._cadence.reset()
        self._backend.reset()
        self._acquisition.reset()
        self._newest, self._changed, self._R_reference = None, False, None

    def _one_of_equals(self, candidates: Candidates, prior: PosePrior | None) -> Candidates:
        """Of orientations that look alike the one nearest to the track, or without one to the last keyframe's best.

        So the decoder compares like with like from keyframe to keyframe.
        """
        R_reference = self._R_reference if prior is None else prior.T_cam_target[:3, :3]
        candidates = candidates.nearest(self._symmetry, R_reference)
        if len(candidates):
            self._R_reference = candidates.T_cam_target[np.argmax(candidates.log_score), :3, :3]
        return candidates

    def _seen(self, detection: Detection) -> Detection:
        """The region that the backend is given; motion has the detection as it is."""
        if self._region.pose_region == "detection" or not detection.silhouette:
            return detection
        return Detection(pad_box(detection.mask, self._region.box_padding), silhouette=False)

    def _observe(self, detection: Detection | None) -> None:
        """Note when a detection is of something else than the one before, lacks a part of it or holds more."""
        before, self._newest = self._newest, detection or self._newest
        if detection is None or before is None:
            return
        smaller, larger = sorted((before.area_px, detection.area_px))
        same_place = box_overlap(before.box_xyxy, detection.box_xyxy) >= _SAME_BOX_OVERLAP
        self._changed |= smaller < _SAME_AREA_SHARE * larger or not same_place


def box_overlap(a: Float, b: Float) -> float:
    """Intersection over union of two boxes (4,) ``x0, y0, x1, y1``."""
    width, height = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    common = max(width, 0.0) * max(height, 0.0)
    area_a, area_b = np.prod(a[2:] - a[:2]), np.prod(b[2:] - b[:2])
    return float(common / (area_a + area_b - common))
