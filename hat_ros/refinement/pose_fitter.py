"""Refinement of one pose on one image: contour against mask and edges, re-rendered as the pose moves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hat_ros.array_types import Float, UInt8
from hat_ros.geometry import lie
from hat_ros.refinement.mask_field import MaskField
from hat_ros.refinement.solver import fit_contour
from hat_ros.refinement.view import TargetViewer, View, contour_lines
from hat_ros.types import Camera, Frame, RotationPrior

_NO_DISTANCE = np.zeros((2, 2), np.float32)
_NO_ORIGIN = np.zeros(2)
# Parts of the target that moved so far against the rest, pixels, leave its contour what it is.
_SAME_CONTOUR_PX = 1.0
# A contour point agrees with the image when its edge or the mask's boundary lies this close, pixels.
_AGREE_PX = 2.5
# The least weight of an edge that supports a pose by itself. With a mask the target is known to be there, and a step
# too small for an edge, as on black before black, is no evidence against a pose.
_MIN_EDGE = 0.1
# Damping while only the mask's outline is known and the start is far off.
_PULL_DAMPING = 1e-3


@dataclass(frozen=True)
class Schedule:
    """Per iteration of one round: reach of the lines, robust scales of edges and mask; pixels, 0 = unused."""

    reach: tuple[float, ...]
    edge: tuple[float, ...]
    mask: tuple[float, ...]
    damping: float = 1e-3

    def scaled(self, factor: float) -> Schedule:
        """The same with the mask's robust scales multiplied."""
        return replace(self, mask=tuple(factor * scale for scale in self.mask))


# A silhouette that leaves out more than this share of the mask is off centre (a mask may lack dark parts of the target,
# but little of it lies beside the target); judged on a view of this size.
_BESIDE_SHARE = 0.15
_CENTRING_PX = 64
# Where the image border cuts the target, what is seen of it changes with each move.
_CENTRING_STEPS = 4
# From coarse to fine: first the mask, then the image's own edges; without a mask, first long search lines.
WITH_MASK = (
    Schedule((0, 0, 6, 4), (1, 1, 3, 2), (10, 6, 4, 3), damping=3e-3),
    Schedule((4, 4, 3.5, 3), (2, 1.5, 1.5, 1.5), (2.5, 2, 1.5, 1.5)),
)
WITHOUT_MASK = (
    Schedule((16, 16, 12, 12), (8, 8, 6, 6), (0, 0, 0, 0)),
    Schedule((8, 8, 6, 6), (4, 4, 3, 3), (0, 0, 0, 0)),
    Schedule((4, 3.5, 3), (1.5, 1.5, 1.5), (0, 0, 0)),
)


@dataclass(frozen=True, eq=False)
class Fit:
    """A refined pose and the evidence for it.

    Attributes:
        T_cam_target: (4, 4).
        information: (8, 8) lower triangle, of ``[dt; r; mask bias; edge bias]``.
        contour: (N, 5) as returned by the solver.
        lines: (N, 5) of the contour it belongs to.
        mask_bias_px: how far outside the target's outline the mask's lies, as estimated.
        view: whose contour it is: rendered at the start of the last round, or at a pose that looks like it.
        shift_px: (2,) how far the target's middle lies from there in the image.
        twist_px: how far its parts lie from there besides, at most.
    """

    T_cam_target: Float
    information: Float
    contour: Float
    lines: Float
    mask_bias_px: float
    view: View
    shift_px: Float
    twist_px: float

    @property
    def shown(self) -> View:
        """What the result looks like: the last round started close to where it ended, so its view is only shifted."""
        return self.view.shifted(self.shift_px)

    @property
    def outline_px(self) -> float:
        """Length of the outline inside the image, pixels."""
        return float(self.lines[self.contour[:, 0] > 0, 2].sum())

    @property
    def support(self) -> float:
        """Share of the contour inside the image that agrees with an edge or the mask's boundary."""
        inside = self.contour[:, 0] > 0
        length = self.lines[:, 2]
        total = length[inside].sum()
        if total <= 0:
            return 0.0
        mask = (self.contour[:, 2] > 0) & (np.abs(self.contour[:, 1]) < _AGREE_PX)
        least = 0.0 if self.contour[:, 2].any() else _MIN_EDGE
        edge = (self.contour[:, 4] > least) & (np.abs(self.contour[:, 3]) < _AGREE_PX)
        return float(length[inside & (edge | mask)].sum() / total)


class PoseFitter:
    """Runs rounds of render, contour, iterations."""

    def __init__(self, viewer: TargetViewer, render_px: int, max_points: int) -> None:
        self.viewer = viewer
        self._render_px = render_px
        self._max_points = max_points
        self._warm_up()

    def fit(
        self,
        T_cam_target: Float,
        camera: Camera,
        image: UInt8,
        field: MaskField | None,
        rounds: tuple[Schedule, ...],
        prior: RotationPrior | None = None,
        to_sun_cam: Float | None = None,
        view: View | None = None,
    ) -> Fit | None:
        """Refine a pose under a rotation prior; None when the target leaves the view on the way.

        With a direction to the sun the contour is that of the sunlit part. The view of the start spares its rendering.
        """
        T = T_cam_target
        fit = None
        for schedule in rounds:
            if fit is not None and fit.twist_px > _SAME_CONTOUR_PX:
                view = None
            view = view or self.viewer.view(T, camera, self._render_px, to_sun_cam)
            if view is None:
                return None
            fit = self.iterate(T, view, camera, image, field, schedule, prior)
            T = fit.T_cam_target
        return fit

    def pull(
        self,
        T_cam_target: Float,
        points_m: Float,
        lines: Float,
        frame: Frame,
        field: MaskField,
        scales_px: Float,
    ) -> Float:
        """Pull given contour points onto the mask's boundary, without rendering: the (4, 4) pose."""
        off = np.zeros(len(scales_px))
        R, t, *_ = fit_contour(
            points_m,
            lines,
            np.ascontiguousarray(T_cam_target[:3, :3]),
            np.ascontiguousarray(T_cam_target[:3, 3]),
            frame.camera.K,
            frame.rgb,
            off,
            field.distance,
            field.origin_px,
            scales_px,
            off,
            np.full(len(scales_px), _PULL_DAMPING),
            np.zeros(3),
            np.zeros((3, 3)),
            self.viewer.target.bounding_radius_m,
        )
        return lie.transform(R, t)

    def centred(
        self,
        T_cam_target: Float,
        camera: Camera,
        field: MaskField,
        luma: UInt8,
        view: View | None = None,
    ) -> Float:
        """The start moved sideways so that silhouette and mask share their centroid, if that covers the mask.

        The view of the start, of any size, spares its rendering.

        Rotation is predicted better than position: a target that drifts across the image leaves the capture range of
        the outline long before it turns out of it.
        """
        best, least = T_cam_target, np.inf
        T = T_cam_target
        for _ in range(_CENTRING_STEPS):
            view = view or self.viewer.view(T, camera, _CENTRING_PX)
            if view is None:
                break
            beside = field.compare(view, luma).extra
            if beside >= least:
                break
            best, least = T, beside
            if beside <= _BESIDE_SHARE * field.area_px:
                break
            pixels = np.argwhere(view.mask)[:, ::-1] / view.scale + view.origin_px
            pixels = pixels[((pixels > -0.5) & (pixels < np.array(luma.shape[::-1]) - 0.5)).all(axis=1)]
            if not len(pixels):
                break
            shift = np.linalg.solve(camera.K, np.append(field.centroid_px - pixels.mean(axis=0), 0.0))
            T = T.copy()
            T[:3, 3] += (T[2, :3] @ self.viewer.target.center_m + T[2, 3]) * shift
            view = None
        return best

    def iterate(
        self,
        T_cam_target: Float,
        view: View,
        camera: Camera,
        image: UInt8,
        field: MaskField | None,
        schedule: Schedule,
        prior: RotationPrior | None = None,
    ) -> Fit:
        """One round with the contour of a view of the start, or of a pose that looks like it."""
        turned, information = np.zeros(3), np.zeros((3, 3))
        if prior is not None:
            turned = lie.so3_log(T_cam_target[:3, :3] @ prior.R_cam_target.T)
            information = prior.information
        lines = contour_lines(view, self._max_points)
        R, t, H, contour, mask_bias, _ = fit_contour(
            lines.points_m,
            lines.lines,
            np.ascontiguousarray(T_cam_target[:3, :3]),
            np.ascontiguousarray(T_cam_target[:3, 3]),
            camera.K,
            image,
            np.array(schedule.reach, dtype=np.float64),
            _NO_DISTANCE if field is None else field.distance,
            _NO_ORIGIN if field is None else field.origin_px,
            np.array(schedule.mask, dtype=np.float64),
            np.array(schedule.edge, dtype=np.float64),
            np.full(len(schedule.reach), schedule.damping),
            turned,
            information,
            self.viewer.target.bounding_radius_m,
        )
        T = lie.transform(R, t)
        shift_px, twist_px = self._displacement_px(view.T_cam_target, T, camera)
        return Fit(T, H, contour, lines.lines, mask_bias, view, shift_px, twist_px)

    def _displacement_px(self, T_before: Float, T_after: Float, camera: Camera) -> tuple[Float, float]:
        """How the target's middle moves in the image (2,), and how far a part of it moves against that at most."""
        target = self.viewer.target
        before, after = (T[:3, :3] @ target.center_m + T[:3, 3] for T in (T_before, T_after))
        angle = lie.angle_between(T_after[:3, :3], T_before[:3, :3])
        radius_px = camera.K[0, 0] * target.bounding_radius_m / before[2]
        twist_px = radius_px * (angle + abs(after[2] / before[2] - 1.0))
        return camera.project(after) - camera.project(before), float(twist_px)

    def _warm_up(self) -> None:
        """Fit the target to a made-up mask, so that everything is compiled before the first frame."""
        side = 2 * _CENTRING_PX
        camera, T = self.viewer.made_up(side)
        image = np.zeros((side, side, 3), np.uint8)
        mask = np.zeros((side, side), np.bool_)
        mask[side // 4 : -side // 4, side // 4 : -side // 4] = True
        field = MaskField(mask)
        self.fit(T, camera, image, field, WITH_MASK)
        self.centred(T, camera, field, np.zeros((side, side), np.uint8))
