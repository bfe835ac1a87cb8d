"""Stage 4: from anchors and relative motion to one output per frame.

What solves for the pose is a :class:`FusionMethod`: the published fusion (:mod:`hat_ros.core.published_fusion`) or the
image-based one of the default preset (:mod:`hat_ros.tracking.image_fusion`); :func:`hat_ros.tracker.choose_fusion`
chooses. Around it stand the state of the output, its covariance and the output at frames where nothing can be solved
for.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from hat_ros.array_types import Float
from hat_ros.config import HatConfig
from hat_ros.core.alignment import SlamAlignment
from hat_ros.core.covariance import ResidualCovariance
from hat_ros.core.published_fusion import Fused
from hat_ros.core.selector import rotation_increment
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry
from hat_ros.types import Detection, Estimate, Frame, Motion, Selection, StateReason, TrackState

_NO_POSE = np.full(7, np.nan)
_NO_COVARIANCE = np.full((6, 6), np.nan)


class FusionMethod(Protocol):
    """What solves for the pose of a frame.

    Attributes:
        alignment: the Sim(3) from SLAM to target coordinates and its observations.
    """

    alignment: SlamAlignment

    def update(self, frame: Frame, detection: Detection | None, motion: Motion, selection: Selection) -> Fused:
        """Advance by one frame.

        Args:
            frame: the image.
            detection: where the target is, None if it was not found.
            motion: target-relative camera state.
            selection: Stage 3's answer.
        """
        ...

    def spread(self, selection: Selection, T_cam_target: Float) -> Float:
        """(6, 6) to add to the covariance of an output (4, 4), in the convention of ``Estimate.covariance``."""
        ...

    def lose(self) -> None:
        """The output was given up as LOST."""
        ...

    def reset(self) -> None:
        """Forget the target's state."""
        ...


class FusionStage:
    """One :meth:`update` per frame; past outputs are never revised.

    Of poses that no image can tell apart the one nearest to the last output counts, carried on by the relative motion:
    the output of a symmetric target is continuous, its candidates stand in one basin, and its rotation about a free
    axis, of which nothing is known, has the variance of a full turn.

    Args:
        config: the whole configuration.
        method: what solves for the pose.
        symmetry: of the target; None = it has none.

    States: UNINITIALISED before the first pose. TRACKING while the method is certain of the pose that it solved for.
    While the pose is only held, predicted, ambiguous, or in doubt: COASTING if it has been TRACKING since the target
    was found, else INITIALISING. LOST once ``coast_limit_frames`` went by without a measurement (an anchor, or a
    supported refinement), unless that is 0; no pose then, and what is found afterwards has to be confirmed anew.
    """

    def __init__(self, config: HatConfig, method: FusionMethod, symmetry: Symmetry | None = None) -> None:
        self._config = config
        self._method = method
        self._symmetry = symmetry or Symmetry()
        self._start()

    def reset(self) -> None:
        """Forget the target's state; the next anchor starts afresh."""
        self._method.reset()
        self._start()

    def resume(self) -> None:
        """The target was confirmed before this stage was started or reset: until it is lost, a pose is no first one."""
        self._is_confirmed = True

    def _start(self) -> None:
        self._is_confirmed = False
        self._covariance = ResidualCovariance()
        self._last_pose: Float | None = None
        self._last_quat = np.array([0.0, 0.0, 0.0, 1.0])
        self._last_motion = Motion.none()
        self._gap_frames = 0
        self._n_resets = 0
        self._lost = False
        self._margin = float("nan")

    def update(self, frame: Frame, detection: Detection | None, motion: Motion, selection: Selection) -> Estimate:
        """Estimate the pose of one frame; arguments as for :meth:`FusionMethod.update`.

        A frame that is not scored has no pose, and nothing advances: intervals count the others.
        """
        if not frame.scored:
            return Estimate(
                frame.stamp_ns,
                TrackState.UNINITIALISED,
                _NO_POSE,
                _NO_COVARIANCE,
                slam_epoch=motion.epoch,
                n_resets=self._n_resets,
                reason=StateReason.NOT_FOUND,
            )
        selection = self._one_of_equals(selection, motion)
        fused = self._method.update(frame, detection, motion, selection)
        self._n_resets += fused.reset
        if fused.T_cam_target is not None and selection.selected >= 0:
            self._margin = selection.margin(fused.T_cam_target[:3, :3], self._config.fusion.gate_angle_deg)
        state, reason, T_cam_target = self._state(fused, motion)
        pose_row, covariance = _NO_POSE, _NO_COVARIANCE
        if state.has_pose and T_cam_target is not None:
            pose_row = self._row(T_cam_target)
            covariance = self._covariance.update(T_cam_target, fused.measurement, fused.predicted, fused.covariance)
            covariance = covariance + self._method.spread(selection, T_cam_target)
            if not self._symmetry.is_trivial:
                covariance = covariance + self._symmetry.free_covariance(T_cam_target)
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
            alignment=self._method.alignment.current,
            slam_epoch=motion.epoch,
            gap_frames=self._gap_frames,
            n_resets=self._n_resets,
            margin=self._margin,
            reason=reason,
            order=self._symmetry.order,
            free_axes=len(self._symmetry.axes),
        )

    def _one_of_equals(self, selection: Selection, motion: Motion) -> Selection:
        """The selection with each candidate as the equal that the track leads to; unchanged without a symmetry."""
        if self._symmetry.is_trivial or self._last_pose is None:
            return selection
        increment = rotation_increment(self._last_motion, motion)
        R_last = self._last_pose[:3, :3]
        R_reference = R_last if increment is None else increment @ R_last
        return replace(selection, candidates=selection.candidates.nearest(self._symmetry, R_reference))

    def _state(self, fused: Fused, motion: Motion) -> tuple[TrackState, StateReason, Float | None]:
        """State, why, and pose after gap handling."""
        T_cam_target = self._fill_gap(motion) if fused.T_cam_target is None else fused.T_cam_target
        if T_cam_target is None and not self._lost:
            return TrackState.UNINITIALISED, StateReason.NOT_FOUND, None
        self._gap_frames = 0 if fused.measurement is not None else self._gap_frames + 1
        limit_frames = self._config.fusion.coast_limit_frames
        self._lost = limit_frames > 0 and self._gap_frames > (0 if self._lost else limit_frames)
        if self._lost:
            self._method.lose()
            self._last_pose = None
            self._is_confirmed = False
            return TrackState.LOST, StateReason.GIVEN_UP, None
        self._last_pose = T_cam_target
        if fused.reason == StateReason.CONFIRMED:
            self._is_confirmed = True
            return TrackState.TRACKING, fused.reason, T_cam_target
        return (TrackState.COASTING if self._is_confirmed else TrackState.INITIALISING), fused.reason, T_cam_target

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
