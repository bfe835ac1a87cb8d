"""Stage 4: alignment, fusion, gap handling; from anchors and relative motion to one output per frame.

Without a refiner this is the paper's causal fusion (``core.causal``) to the letter. With one, every output is also
refined on its own image (``core.refined``). Around either stand the state of the output, its covariance and what is
said at frames where nothing can be solved for.
"""

from __future__ import annotations

import numpy as np

from hat_ros.config import HatConfig
from hat_ros.core.published_fusion import AreaConfidence, CausalFusion, Fused
from hat_ros.core.selector import box_area_px, rotation_increment
from hat_ros.core.uncertainty import KeyframeSpread, ResidualCovariance
from hat_ros.geometry import lie
from hat_ros.tracking.confidence import BasinConfidence
from hat_ros.tracking.image_fusion import RefinedFusion
from hat_ros.tracking.refiner import Refiner
from hat_ros.types import Detection, Estimate, Float, Frame, Motion, Selection, TrackState

_NO_POSE = np.full(7, np.nan)
_NO_COVARIANCE = np.full((6, 6), np.nan)


class FusionStage:
    """One :meth:`update` per frame; past outputs are never revised.

    States: UNINITIALISED before the first pose. TRACKING while poses are solved for: from anchors and motion, or, with
    a refiner, supported by this frame's image, and in a basin that decoder and appearance vouch for
    (:class:`BasinConfidence`). COASTING while the pose is only held, predicted, ambiguous, or in doubt. LOST once
    ``coast_limit_frames`` went by without a measurement (an anchor, or a supported refinement); no pose then.
    """

    def __init__(self, config: HatConfig, refiner: Refiner | None) -> None:
        self._config = config
        self._refiner = refiner
        self._start()

    def reset(self) -> None:
        """Forget the target's state; the next anchor starts afresh."""
        if self._refiner is not None:
            self._refiner.reset()
        self._start()

    def _start(self) -> None:
        config = self._config
        self._causal = CausalFusion(config.alignment, config.fusion) if self._refiner is None else None
        self._refined = RefinedFusion(config, self._refiner) if self._refiner is not None else None
        self._area_confidence = AreaConfidence(config.fusion)
        self._covariance = ResidualCovariance()
        self._spread = KeyframeSpread(config.fusion.gate_angle_deg)
        self._last_pose: Float | None = None
        self._last_quat = np.array([0.0, 0.0, 0.0, 1.0])
        self._last_motion = Motion.none()
        self._gap_frames = 0
        self._n_resets = 0
        self._lost = False
        self._confidence = BasinConfidence(config.refinement, config.fusion.gate_angle_deg)

    def update(self, frame: Frame, detection: Detection | None, motion: Motion, selection: Selection) -> Estimate:
        """Estimate the pose of one frame.

        Args:
            frame: the image; only its stamp is read without a refiner.
            detection: where the target is; only a refiner looks.
            motion: target-relative camera state.
            selection: Stage 3's answer.
        """
        anchor, confidence = selection.anchor, 1.0
        if anchor is not None:
            confidence = self._area_confidence.update(box_area_px(selection.candidates.box_xyxy))
        if self._refined is not None:
            decided = anchor is not None and self._confidence.decides(selection, anchor)
            fused = self._refined.update(frame, detection, motion, anchor, confidence, decided)
        else:
            fused = self._causal.update(motion, anchor, confidence)
        self._n_resets += fused.reset
        self._confidence.update(selection, fused.T_cam_target)
        state, T_cam_target = self._state(fused, motion)
        pose_row, covariance = _NO_POSE, _NO_COVARIANCE
        if state.has_pose:
            pose_row = self._row(T_cam_target)
            covariance = self._covariance.update(T_cam_target, fused.measurement, fused.predicted, fused.covariance)
            if self._refined is not None:  # without a refiner the anchors are the residuals
                covariance = covariance + self._spread.update(selection, T_cam_target)
        self._last_motion = motion
        return Estimate(
            stamp_ns=frame.stamp_ns,
            state=state,
            pose_row=pose_row,
            covariance=covariance,
            keyframe=len(selection.candidates) > 0,
            n_candidates=len(selection.candidates),
            anchor=selection.selected,
            gate_weight=fused.gate_weight,
            alignment=(self._refined or self._causal).alignment.current,
            slam_epoch=motion.epoch,
            gap_frames=self._gap_frames,
            n_resets=self._n_resets,
            margin=self._confidence.margin,
        )

    def _state(self, fused: Fused, motion: Motion) -> tuple[TrackState, Float | None]:
        """State and pose after gap handling."""
        T_cam_target = self._fill_gap(motion) if fused.T_cam_target is None else fused.T_cam_target
        if T_cam_target is None and not self._lost:
            return TrackState.UNINITIALISED, None
        self._gap_frames = 0 if fused.measurement is not None else self._gap_frames + 1
        self._lost = self._gap_frames > (0 if self._lost else self._config.fusion.coast_limit_frames)
        if self._lost:
            if self._refined is not None:
                self._refined.lose()
            self._last_pose = None
            return TrackState.LOST, None
        self._last_pose = T_cam_target
        if self._refined is None:
            certain = fused.T_cam_target is not None
        else:
            measured = fused.measurement is not None and not fused.doubtful
            certain = measured and self._confidence.vouches(fused.confirmed)
        return (TrackState.TRACKING if certain else TrackState.COASTING), T_cam_target

    def _fill_gap(self, motion: Motion) -> Float | None:
        """The last pose, held, or turned by the SLAM rotation about a held position."""
        if self._last_pose is None or self._config.fusion.gap_fill == "hold":
            return self._last_pose
        increment = rotation_increment(self._last_motion, motion)
        if increment is None:
            return self._last_pose
        return lie.transform(increment @ self._last_pose[:3, :3], self._last_pose[:3, 3])

    def _row(self, T_cam_target: Float) -> Float:
        """Pose row whose quaternion stays in the hemisphere of the last one."""
        row = lie.row_from_matrix(T_cam_target)
        if row[3:] @ self._last_quat < 0:
            row[3:] = -row[3:]
        self._last_quat = row[3:]
        return row
