"""Refines each fused pose on the current image, and says how far to trust it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hat_ros import lie
from hat_ros.config import RefinementConfig
from hat_ros.refinement.covariance import outline_floor, outline_misfit_px, pose_covariance
from hat_ros.refinement.refiner import WITH_MASK, WITHOUT_MASK, Fit, PoseFitter
from hat_ros.refinement.sunlight import LightField, SunMatcher
from hat_ros.refinement.view import MaskField, Overlap, TargetViewer, View
from hat_ros.target import Target
from hat_ros.types import Detection, Frame, Refined, RotationPrior

# The mask's robust scales are meant for a target of this size or more and shrink with smaller ones.
_USUAL_SIZE_PX = 250.0
# Share of a silhouette that is black on black from which the sun is looked for.
_SHADOW_SHARE = 0.05
# Missing less makes a pose a little small and far, which then misses still less: over many frames that adds up. So the
# sun is looked for as well where the mask shows so much beside the silhouette (with what is black on black, as a share
# of the silhouette), and not little of what it misses is black.
_SMALL_SHARE, _BLACK_SHARE = 0.03, 0.2
# A sunlit contour is a stub, which agrees with anything, where silhouette and mask disagree by so many pixels along it.
_STUB_MISFIT_PX = 5.0
_SCALE_LIMITS = (0.4, 1.0)
# From a good prediction the fine round alone arrives: this share of the contour agrees, and nothing moved further.
_ENOUGH_SUPPORT = 0.7
_SMALL_MOVE_PX = 2.0


class FusedPoseRefiner:
    """Contour refinement of one pose per frame; uses nothing but the present frame.

    Args:
        config: the ``refinement`` section.
        target: the CAD model.
    """

    def __init__(self, config: RefinementConfig, target: Target) -> None:
        self._config = config
        self._target = target
        self._start_information = np.radians(config.start_sigma_deg) ** -2 * np.eye(3)
        self._viewer = TargetViewer(target)
        self._sun = SunMatcher(self._viewer)
        self._fitter = PoseFitter(self._viewer, config.render_px, config.max_points)

    def refine(
        self,
        frame: Frame,
        detection: Detection | None,
        T_cam_target: NDArray[np.float64],
        prior: RotationPrior | None = None,
    ) -> Refined | None:
        """Refine a pose within its basin.

        Args:
            frame: the current image.
            detection: its mask, None when there is none (the image's edges alone are used then).
            T_cam_target: (4, 4) fused pose.
            prior: what is known of its rotation; None = ``start_sigma_deg`` about the start.

        Returns:
            The refined pose with its uncertainty, or None when the target is out of view, nothing in the image can be
            measured, or the refinement would leave the basin.
        """
        field = MaskField(detection.mask) if detection is not None and detection.silhouette else None
        luma = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        prior = prior or RotationPrior(T_cam_target[:3, :3], self._start_information)
        start, view = self._start(frame, field, luma, T_cam_target)
        in_shadow = view is not None and field is not None and _lies_in_shadow(field.compare(view, luma))
        if in_shadow:
            sunlit = self._sunlit(frame, field, luma, start, prior, view)
            if sunlit is not None:
                return sunlit
        fit = self._fine(frame, field, start, prior, view) or self._fit_all(frame, field, start, prior, view)
        if fit is None:
            return None
        areas = None if field is None else field.compare(fit.shown, luma)
        refined = self._judged(frame, start, fit, areas)
        if in_shadow or refined is None or areas is None or not _looks_small(areas):
            return refined
        # A pose too small and far hides its own shadow.
        sunlit = self._sunlit(frame, field, luma, start, prior, view)
        return sunlit if sunlit is not None and sunlit.quality > refined.quality else refined

    def _sunlit(
        self,
        frame: Frame,
        field: MaskField,
        luma: NDArray[np.uint8],
        start: NDArray[np.float64],
        prior: RotationPrior,
        view: View,
    ) -> Refined | None:
        """Refined by the contour of what the sun shines on; None where that is hardly anything, or no sun is found."""
        sunlight = self._sun.match(view, LightField(frame.rgb, field.mask))
        if sunlight is None:
            return None
        lit = self._viewer.in_sunlight(view, sunlight.to_sun_cam)
        fit = self._fit_all(frame, field, start, prior, lit, sunlight.to_sun_cam)
        if fit is None:
            return None
        refined = self._judged(frame, start, fit, field.compare(fit.shown, luma))
        return refined if refined is not None and refined.misfit_px <= _STUB_MISFIT_PX else None

    def _judged(self, frame: Frame, start: NDArray[np.float64], fit: Fit, areas: Overlap | None) -> Refined | None:
        """What a fit is worth by its agreement with the mask; None when it left the basin of its start."""
        if not self._same_basin(start, fit.T_cam_target):
            return None
        covariance = pose_covariance(fit, self._target.bounding_radius_m)
        if covariance is None:
            return None
        focal_px = float(frame.camera.K[0, 0])
        covariance = covariance + outline_floor(fit.T_cam_target, focal_px, self._target.bounding_radius_m)
        overlap, visible_overlap, misfit_px = float("nan"), float("nan"), 0.0
        if areas is not None:
            overlap, visible_overlap = areas.union_share, areas.visible_share
            misfit_px = outline_misfit_px(areas, fit.outline_px)
        return Refined(
            lie.row_from_matrix(fit.T_cam_target), covariance, overlap, fit.support, visible_overlap, misfit_px
        )

    def _start(
        self, frame: Frame, field: MaskField | None, luma: NDArray[np.uint8], T_cam_target: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], View | None]:
        """Where to start from, centred on the mask if need be, and what the target looks like there."""
        view = self._viewer.view(T_cam_target, frame.camera, self._config.render_px)
        if view is None or field is None:
            return T_cam_target, view
        start = self._fitter.centred(T_cam_target, frame.camera, field, luma, view)
        if start is not T_cam_target:
            view = self._viewer.view(start, frame.camera, self._config.render_px)
        return start, view

    def _fine(
        self,
        frame: Frame,
        field: MaskField | None,
        start: NDArray[np.float64],
        prior: RotationPrior,
        view: View | None,
    ) -> Fit | None:
        """The finest round alone; None unless that explains the image and hardly moves the start."""
        if field is None or view is None:
            return None
        rounds = WITH_MASK[-1:]
        fit = self._fitter.fit(start, frame.camera, frame.rgb, field, rounds, prior, view=view)
        if fit.support < _ENOUGH_SUPPORT:
            return None
        # The view is the start's.
        return fit if np.hypot(*fit.shift_px) + fit.twist_px <= _SMALL_MOVE_PX else None

    def _fit_all(
        self,
        frame: Frame,
        field: MaskField | None,
        start: NDArray[np.float64],
        prior: RotationPrior,
        view: View | None,
        to_sun_cam: NDArray[np.float64] | None = None,
    ) -> Fit | None:
        """All rounds, from the widest to the finest."""
        rounds = WITHOUT_MASK
        if field is not None:
            factor = float(np.clip(field.size_px / _USUAL_SIZE_PX, *_SCALE_LIMITS))
            rounds = (WITH_MASK[0].scaled(factor), *WITH_MASK[1:])
        return self._fitter.fit(start, frame.camera, frame.rgb, field, rounds, prior, to_sun_cam, view)

    def reset(self) -> None:
        """Nothing to forget: every frame stands for itself."""

    def _same_basin(self, T_before: NDArray[np.float64], T_after: NDArray[np.float64]) -> bool:
        turn = np.degrees(lie.angle_between(T_before[:3, :3], T_after[:3, :3]))
        center_before = T_before[:3, :3] @ self._target.center_m + T_before[:3, 3]
        center_after = T_after[:3, :3] @ self._target.center_m + T_after[:3, 3]
        shift = np.linalg.norm(center_after - center_before) / np.linalg.norm(center_before)
        return bool(turn <= self._config.max_rotation_deg and shift <= self._config.max_shift)


def _lies_in_shadow(areas: Overlap) -> bool:
    """Whether much of a silhouette is missing from the mask before black."""
    return areas.hidden > _SHADOW_SHARE * (areas.common + areas.hidden + areas.missing)


def _looks_small(areas: Overlap) -> bool:
    """Whether the mask reaches beyond a silhouette some of which lies before black."""
    small = areas.hidden + areas.extra > _SMALL_SHARE * (areas.common + areas.hidden + areas.missing)
    return small and areas.hidden > _BLACK_SHARE * areas.missing
