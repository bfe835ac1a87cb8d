"""Refines each fused pose on the current image, and estimates its covariance and its support in the image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from hat_ros.array_types import Float
from hat_ros.config import RefinementConfig
from hat_ros.geometry import lie
from hat_ros.refinement.covariance import outline_floor, outline_misfit_px, pose_covariance
from hat_ros.refinement.mask_field import MaskField, Overlap
from hat_ros.refinement.pose_fitter import WITH_MASK, WITHOUT_MASK, Fit, PoseFitter, Schedule
from hat_ros.refinement.sunlight import LightField, SunMatcher
from hat_ros.refinement.view import TargetViewer, View, contour_lines
from hat_ros.target.model import Target
from hat_ros.types import Detection, Frame, Refined, RotationPrior

# The mask's robust scales are meant for a target of this size or more and shrink with smaller ones.
_USUAL_SIZE_PX = 250.0
_SCALE_LIMITS = (0.4, 1.0)
# Share of a silhouette that is black on black from which the sun is looked for.
_SHADOW_SHARE = 0.05
# Missing less makes a pose a little small and far, which then misses still less: over many frames that adds up. So the
# sun is looked for as well where the mask shows so much beside the silhouette (with what is black on black, as a share
# of the silhouette), and not little of what it misses is black.
_SMALL_SHARE, _BLACK_SHARE = 0.03, 0.2
# A sunlit contour is a stub, which fits anything, where silhouette and mask disagree by so many pixels along it;
# where they disagree by so many times that at the start, refinement is not tried.
_STUB_MISFIT_PX = 5.0
_HOPELESS_FACTOR = 2.0
# From a good prediction the fine round alone arrives: this share of the contour agrees, and nothing moved further.
_ENOUGH_SUPPORT = 0.7
_SMALL_MOVE_PX = 2.0


class _Image:
    """One image and its mask, ready for every pose that is refined on it.

    Attributes:
        frame, detection: what was given.
        luma: (H, W) the image in grey.
        field: the mask, None without a silhouette.
    """

    def __init__(self, frame: Frame, detection: Detection | None) -> None:
        self.frame, self.detection = frame, detection
        self.luma = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        self.field = MaskField(detection.mask) if detection is not None and detection.silhouette else None

    @cached_property
    def light(self) -> LightField | None:
        """What shaded models are compared with, None without a mask."""
        return None if self.field is None else LightField(self.frame.rgb, self.field.mask)

    def areas(self, view: View | None) -> Overlap | None:
        """Agreement of mask and view, None without one of them."""
        return None if self.field is None or view is None else self.field.compare(view, self.luma)


@dataclass(frozen=True, eq=False)
class _Task:
    """A pose to refine on an image.

    Attributes:
        image: which.
        prior: what is known of the rotation.
        start: (4, 4) pose to start from.
        view: what the target looks like there, None when it is out of view.
        areas: agreement of mask and view, None without one of them.
    """

    image: _Image
    prior: RotationPrior
    start: Float
    view: View | None
    areas: Overlap | None


class ContourRefiner:
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
        self._image: _Image | None = None  # the newest: several poses are refined on it where the track is ambiguous

    def refine(
        self,
        frame: Frame,
        detection: Detection | None,
        T_cam_target: Float,
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
        task = self._task(self._prepared(frame, detection), T_cam_target, prior)
        in_shadow = task.areas is not None and _lies_in_shadow(task.areas)
        if in_shadow:
            sunlit = self._sunlit(task)
            if sunlit is not None:
                return sunlit
        fit = self._fine(task) or self._fit_all(task, task.view)
        if fit is None:
            return None
        areas = task.image.areas(fit.shown)
        refined = self._judged(task, fit, areas)
        if in_shadow or refined is None or areas is None or not _looks_small(areas):
            return refined
        # A pose too small and far hides its own shadow.
        sunlit = self._sunlit(task)
        return sunlit if sunlit is not None and sunlit.quality > refined.quality else refined

    def reset(self) -> None:
        """Forget the last image; nothing else is kept between frames."""
        self._image = None

    def _prepared(self, frame: Frame, detection: Detection | None) -> _Image:
        """Prepare an image, unless it is the one before."""
        if self._image is None or self._image.frame is not frame or self._image.detection is not detection:
            self._image = _Image(frame, detection)
        return self._image

    def _task(self, image: _Image, T_cam_target: Float, prior: RotationPrior | None) -> _Task:
        """The start is centred on the mask if need be."""
        camera = image.frame.camera
        prior = prior or RotationPrior(T_cam_target[:3, :3], self._start_information)
        start, view = T_cam_target, self._viewer.view(T_cam_target, camera, self._config.render_px)
        if view is not None and image.field is not None:
            start = self._fitter.centred(T_cam_target, camera, image.field, image.luma, view)
            if start is not T_cam_target:
                view = self._viewer.view(start, camera, self._config.render_px)
        return _Task(image, prior, start, view, image.areas(view))

    def _sunlit(self, task: _Task) -> Refined | None:
        """Refined by the contour of what the sun shines on; None where that is hardly anything, or no sun is found."""
        if task.view is None or task.areas is None or task.image.light is None:
            return None
        sunlight = self._sun.match(task.view, task.image.light)
        if sunlight is None:
            return None
        lit = self._viewer.in_sunlight(task.view, sunlight.to_sun_cam)
        outline_px = contour_lines(lit, self._config.max_points).length_px
        if outline_misfit_px(task.areas, outline_px) > _HOPELESS_FACTOR * _STUB_MISFIT_PX:
            return None
        fit = self._fit_all(task, lit, sunlight.to_sun_cam)
        if fit is None:
            return None
        refined = self._judged(task, fit, task.image.areas(fit.shown))
        return refined if refined is not None and refined.misfit_px <= _STUB_MISFIT_PX else None

    def _judged(self, task: _Task, fit: Fit, areas: Overlap | None) -> Refined | None:
        """The result with its covariance and its agreement with the mask; None when it left the basin of its start."""
        if not self._same_basin(task.start, fit.T_cam_target):
            return None
        covariance = pose_covariance(fit, self._target.bounding_radius_m)
        if covariance is None:
            return None
        focal_px = float(task.image.frame.camera.K[0, 0])
        covariance = covariance + outline_floor(fit.T_cam_target, focal_px, self._target.bounding_radius_m)
        overlap, visible_overlap, misfit_px = float("nan"), float("nan"), 0.0
        if areas is not None:
            overlap, visible_overlap = areas.union_share, areas.visible_share
            misfit_px = outline_misfit_px(areas, fit.outline_px)
        return Refined(
            lie.row_from_matrix(fit.T_cam_target), covariance, overlap, fit.support, visible_overlap, misfit_px
        )

    def _fine(self, task: _Task) -> Fit | None:
        """The finest round alone; None unless that explains the image and hardly moves the start."""
        frame, field, view = task.image.frame, task.image.field, task.view
        if field is None or view is None:
            return None
        fit = self._fitter.fit(task.start, frame.camera, frame.rgb, field, WITH_MASK[-1:], task.prior, view=view)
        if fit is None or fit.support < _ENOUGH_SUPPORT:
            return None
        # The view is the start's.
        return fit if np.hypot(*fit.shift_px) + fit.twist_px <= _SMALL_MOVE_PX else None

    def _fit_all(self, task: _Task, view: View | None, to_sun_cam: Float | None = None) -> Fit | None:
        """All rounds, from the widest to the finest, with a view of the start, all or its sunlit part."""
        frame, field = task.image.frame, task.image.field
        rounds: tuple[Schedule, ...] = WITHOUT_MASK
        if field is not None:
            factor = float(np.clip(field.size_px / _USUAL_SIZE_PX, *_SCALE_LIMITS))
            rounds = (WITH_MASK[0].scaled(factor), *WITH_MASK[1:])
        return self._fitter.fit(task.start, frame.camera, frame.rgb, field, rounds, task.prior, to_sun_cam, view)

    def _same_basin(self, T_before: Float, T_after: Float) -> bool:
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
