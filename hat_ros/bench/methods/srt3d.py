"""SRT3D, the sparse region tracker, as a baseline with automatic initialisation.

Stoiber, Pfanne, Strobl, Triebel, Albu-Schaeffer, "SRT3D: A Sparse Region-Based 3D Object Tracking Approach for the
Real World", IJCV 130 (2022). Settings are those of its public release. One thing differs: the contour points are
rendered at the previous pose instead of being looked up from 2,562 stored views (whose nearest one is up to two
degrees away), and free distances beyond the rendering's reach count as unbounded. The regulariser of the release is
meant for targets about 0.8 m away; it is scaled with the distance, so that a model in other units tracks the same.

The tracker starts from the best appearance hypothesis of the first frame that has one and never starts again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import Bool, Float, Int, UInt8
from hat_ros.config import HatConfig
from hat_ros.geometry import lie
from hat_ros.hypotheses.stage import HypothesisStage
from hat_ros.refinement.view import TargetViewer, contour_lines
from hat_ros.segmentation.stage import SegmentationStage
from hat_ros.target.contour import MAX_FREE_PX
from hat_ros.target.model import Target
from hat_ros.tracker import StageWrapper, Step
from hat_ros.types import Camera, Candidates, Estimate, Frame, Motion, Selection, TrackState

SCALES = (5, 2, 2, 1, 1, 1, 1)
N_LINES = 200
RENDER_PX = 300
FUNCTION_LENGTH, DISTRIBUTION_LENGTH = 8, 12
FUNCTION_AMPLITUDE = 0.36
LEARNING_RATE = 1.3
MIN_CONTINUOUS_PX = 6.0
HISTOGRAM_BINS = 32
HISTOGRAM_RATE = 0.2
UNCONSIDERED_PX, CONSIDERED_PX = 1, 18
TIKHONOV_ROTATION, TIKHONOV_TRANSLATION = 5000.0, 500_000.0
WORKING_DISTANCE_M = 0.8

_SEGMENTS = FUNCTION_LENGTH + DISTRIBUTION_LENGTH - 1
_CENTRE = 0.5 * (DISTRIBUTION_LENGTH - 1)
_MIN_VARIANCE = 1.0 / (2.0 * np.arctanh(2.0 * FUNCTION_AMPLITUDE) ** 2)
_STEP = np.sign(np.arange(FUNCTION_LENGTH) - 0.5 * (FUNCTION_LENGTH - 1))
_H_FOREGROUND = 0.5 - FUNCTION_AMPLITUDE * _STEP
_H_BACKGROUND = 1.0 - _H_FOREGROUND


class ColorHistograms:
    """Normalised RGB histograms of foreground and background."""

    def __init__(self) -> None:
        shape = (HISTOGRAM_BINS**3,)
        self._foreground, self._background = np.zeros(shape), np.zeros(shape)
        self._started = False

    def learn(self, foreground: UInt8, background: UInt8) -> None:
        """Blend in the colours of this frame: (N, 3), (M, 3) RGB; the first ones count fully."""
        rate = HISTOGRAM_RATE if self._started else 1.0
        for histogram, rgb in ((self._foreground, foreground), (self._background, background)):
            if len(rgb):
                counts = np.bincount(_bins(rgb), minlength=len(histogram))
                histogram *= 1.0 - rate
                histogram += rate * counts / len(rgb)
        self._started = True

    def probabilities(self, rgb: UInt8) -> tuple[Float, Float]:
        """Foreground and background probability of each colour, summing to one; a half each where unseen."""
        index = _bins(rgb)
        foreground, background = self._foreground[index], self._background[index]
        total = foreground + background
        share = np.divide(foreground, total, out=np.full(len(index), 0.5), where=total > 0)
        return share, 1.0 - share


def _bins(rgb: UInt8) -> Int:
    level = rgb.astype(np.int64) * HISTOGRAM_BINS // 256
    return (level[..., 0] * HISTOGRAM_BINS + level[..., 1]) * HISTOGRAM_BINS + level[..., 2]


@dataclass(frozen=True, eq=False)
class _Contour:
    """Contour points of one view, target frame: centres, normals (from the image normal), free distances in metres."""

    points_m: Float
    normals: Float
    inside_m: Float
    outside_m: Float


@dataclass(frozen=True, eq=False)
class _Lines:
    """Correspondence lines that were accepted: point index, image position, unit normal, and what the colours say."""

    index: NDArray[np.intp]
    centre_px: Float
    normal: Float
    per_segment: Float  # |dominant normal component| / scale: pixels along the normal to segments
    posterior: Float  # (N, 12)
    mean: Float
    variance: Float


class RegionTracker:
    """Follows a pose from frame to frame by the colours on both sides of its contour."""

    def __init__(self, target: Target) -> None:
        self._viewer = TargetViewer(target)
        self._histograms = ColorHistograms()

    def start(self, frame: Frame, T_cam_target: Float) -> None:
        """Learn the colours at a given pose."""
        self._histograms = ColorHistograms()
        self._learn(frame, T_cam_target)

    def track(self, frame: Frame, T_cam_target: Float) -> Float | None:
        """Pose in this frame from the one in the last, (4, 4); None when the target left the view."""
        contour = self._contour(T_cam_target, frame.camera)
        if contour is None:
            return None
        T = T_cam_target
        for scale in SCALES:
            lines = self._correspond(frame, T, contour, scale)
            for is_global in (True, False):
                T = _update(T, contour, lines, frame.camera, is_global)
        self._learn(frame, T)
        return T

    def _contour(self, T_cam_target: Float, camera: Camera) -> _Contour | None:
        view = self._viewer.view(T_cam_target, camera, RENDER_PX)
        if view is None:
            return None
        lines = contour_lines(view, N_LINES)
        flat = np.column_stack([lines.lines[:, :2], np.zeros(len(lines.lines))])
        depth_m = (lines.points_m @ T_cam_target[:3, :3].T + T_cam_target[:3, 3])[:, 2]
        metres = depth_m / camera.K[0, 0]
        reach_px = (MAX_FREE_PX - 0.5) / view.scale
        free = np.where(lines.lines[:, 3:5] >= reach_px, np.inf, lines.lines[:, 3:5] * metres[:, None])
        return _Contour(lines.points_m, flat @ T_cam_target[:3, :3], free[:, 0], free[:, 1])

    def _correspond(self, frame: Frame, T: Float, contour: _Contour, scale: int) -> _Lines:
        camera = frame.camera
        centre, normal, pixels_per_metre, usable = _project(T, contour, camera)
        free = np.minimum(contour.inside_m, contour.outside_m) * pixels_per_metre / scale
        usable &= free >= MIN_CONTINUOUS_PX
        dominant = np.abs(normal).max(axis=1)
        step = normal / np.where(dominant > 0, dominant, 1.0)[:, None]  # one pixel along the dominant axis
        offsets = np.arange(_SEGMENTS * scale) - 0.5 * (_SEGMENTS * scale - 1)
        pixels = np.rint(centre[:, None] + offsets[None, :, None] * step[:, None])
        limit = np.array([camera.width, camera.height])
        usable &= ((pixels >= 0) & (pixels < limit)).all(axis=(1, 2))
        index = np.flatnonzero(usable)
        xy = pixels[index].astype(np.intp)
        foreground, background = self._histograms.probabilities(frame.rgb[xy[..., 1], xy[..., 0]].reshape(-1, 3))
        p_f, p_b = (p.reshape(len(index), _SEGMENTS, scale).prod(axis=2) for p in (foreground, background))
        total = p_f + p_b
        p_f = np.divide(p_f, total, out=np.full_like(p_f, 0.5), where=total > 0)
        posterior = _posterior(p_f, 1.0 - p_f)
        offset = np.arange(DISTRIBUTION_LENGTH) - _CENTRE
        mean = posterior @ offset
        variance = np.maximum(posterior @ offset**2 - mean**2, _MIN_VARIANCE)
        return _Lines(index, centre[index], normal[index], dominant[index] / scale, posterior, mean, variance)

    def _learn(self, frame: Frame, T: Float) -> None:
        contour = self._contour(T, frame.camera)
        if contour is None:
            return
        centre, normal, pixels_per_metre, usable = _project(T, contour, frame.camera)
        walk = np.arange(UNCONSIDERED_PX + 0.5, UNCONSIDERED_PX + CONSIDERED_PX)
        colors = []
        for sign, free_m in ((-1.0, contour.inside_m), (1.0, contour.outside_m)):
            pixels = np.rint(centre[:, None] + sign * walk[None, :, None] * normal[:, None])
            limit = np.array([frame.camera.width, frame.camera.height])
            good = usable[:, None] & (walk[None] <= (free_m * pixels_per_metre)[:, None])
            good &= ((pixels >= 0) & (pixels < limit)).all(axis=2)
            xy = pixels[good].astype(np.intp)
            colors.append(frame.rgb[xy[:, 1], xy[:, 0]])
        self._histograms.learn(*colors)


def _project(T: Float, contour: _Contour, camera: Camera) -> tuple[Float, Float, Float, Bool]:
    """Image position (N, 2), unit image normal (N, 2), pixels per metre (N,), and which points can be used."""
    points = contour.points_m @ T[:3, :3].T + T[:3, 3]
    normal = (contour.normals @ T[:3, :3].T)[:, :2]
    length = np.linalg.norm(normal, axis=1)
    usable = (points[:, 2] > 1e-6) & (length > 1e-6)
    points[~usable] = (0.0, 0.0, 1.0)
    normal = normal / np.where(usable, length, 1.0)[:, None]
    return camera.project(points), normal, camera.K[0, 0] / points[:, 2], usable


def _posterior(p_f: Float, p_b: Float) -> Float:
    """Probability of the 12 contour positions given the colours of 19 segments: (N, 19) each -> (N, 12)."""
    windows_f = np.lib.stride_tricks.sliding_window_view(p_f, FUNCTION_LENGTH, axis=1)
    windows_b = np.lib.stride_tricks.sliding_window_view(p_b, FUNCTION_LENGTH, axis=1)
    posterior = (windows_f * _H_FOREGROUND + windows_b * _H_BACKGROUND).prod(axis=2)
    return posterior / posterior.sum(axis=1, keepdims=True)


def _update(T: Float, contour: _Contour, lines: _Lines, camera: Camera, is_global: bool) -> Float:
    """One regularised Newton step in the body frame."""
    if not len(lines.index):
        return T
    body = contour.points_m[lines.index]
    points = body @ T[:3, :3].T + T[:3, 3]
    z = points[:, 2]
    delta = np.einsum("nk,nk->n", lines.normal, camera.project(points) - lines.centre_px) * lines.per_segment
    if is_global:
        slope = (lines.mean - delta) / lines.variance
    else:
        position = delta + _CENTRE
        lower = np.floor(position).astype(int)
        within = (lower >= 0) & (lower < DISTRIBUTION_LENGTH - 1)
        lower = np.clip(lower, 0, DISTRIBUTION_LENGTH - 2)
        log_p = np.log(lines.posterior + 1e-300)
        row = np.arange(len(lower))
        slope = (log_p[row, lower + 1] - log_p[row, lower]) * LEARNING_RATE / lines.variance
        slope = np.where(within, slope, 0.0)
    # d(image)/d(camera point), then d(camera point)/d(body rotation, body translation) = R [-[X]x, I].
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    n = lines.normal * lines.per_segment[:, None]
    by_point = np.column_stack(
        [n[:, 0] * fx / z, n[:, 1] * fy / z, -(n[:, 0] * fx * points[:, 0] + n[:, 1] * fy * points[:, 1]) / z**2]
    )
    by_body = by_point @ T[:3, :3]
    J = np.column_stack([np.cross(body, by_body), by_body])
    translation = TIKHONOV_TRANSLATION * (WORKING_DISTANCE_M / np.mean(z)) ** 2
    hessian = np.diag([TIKHONOV_ROTATION] * 3 + [translation] * 3) + (J / lines.variance[:, None]).T @ J
    theta = np.linalg.solve(hessian, J.T @ slope)
    return T @ lie.transform(lie.so3_exp(theta[:3]), theta[3:])


class Srt3d:
    """The tracker as a method: started by the front ends, then on its own."""

    causal = True
    concurrent = False  # a step follows the pose of the one before

    def __init__(self, config: HatConfig, target: Target, wrap: StageWrapper) -> None:
        config = replace(config, keyframes=replace(config.keyframes, gap_frames=1))
        self._segmentation = wrap("segmentation", SegmentationStage(config, target))
        self._hypotheses = wrap("hypotheses", HypothesisStage(config, target))
        self._tracker = RegionTracker(target)
        self._T_cam_target: Float | None = None
        self._is_started = False

    def step(self, frame: Frame) -> Step:
        """Follow; before the first pose, look for one."""
        detection, candidates = None, Candidates.none()
        if self._is_started:
            if self._T_cam_target is not None:
                self._T_cam_target = self._tracker.track(frame, self._T_cam_target)
        else:
            detection = self._segmentation.update(frame, None)
            candidates = self._hypotheses.update(frame, detection, None)
            self._start(frame, candidates)
        return Step(detection, candidates, Motion.none(), Selection.none(), self._estimate(frame, candidates))

    def finish(self) -> list[Estimate]:
        """Nothing: every answer is final."""
        return []

    def _start(self, frame: Frame, candidates: Candidates) -> None:
        if len(candidates) and np.isfinite(candidates.log_score[0]):
            self._T_cam_target = candidates.T_cam_target[0]
            self._tracker.start(frame, self._T_cam_target)
            self._is_started = True

    def _estimate(self, frame: Frame, candidates: Candidates) -> Estimate:
        if self._T_cam_target is None:
            state = TrackState.LOST if self._is_started else TrackState.UNINITIALISED
            row = np.full(7, np.nan)
        else:
            state, row = TrackState.TRACKING, lie.row_from_matrix(self._T_cam_target)
        return Estimate(
            frame.stamp_ns,
            state,
            row,
            np.full((6, 6), np.nan),
            keyframe=len(candidates) > 0,
            n_candidates=len(candidates),
            anchor=0 if len(candidates) else -1,
        )
