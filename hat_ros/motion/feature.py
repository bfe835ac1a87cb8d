"""Backend ``feature``: target-relative motion from point tracks, without learned weights.

Per frame: follow the points, locate the camera against the points known, adjust the window, emit. A pose once emitted
is never revised; what the window learns later about its past only shapes what is emitted next.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from numba import njit

from hat_ros.array_types import Float, UInt8
from hat_ros.config import FeatureSlamConfig, HatConfig
from hat_ros.geometry import lie
from hat_ros.motion.surface import SurfacePrior
from hat_ros.motion.tracks import PointTracks, detect
from hat_ros.motion.window import Window, warm_up
from hat_ros.target.model import Target
from hat_ros.target.rays import ray_caster
from hat_ros.types import Camera, Detection, Frame, Motion, PosePrior

# Points needed to start, and points that must agree with a new pose.
_MIN_POINTS = 8
# A point this far off is wrong at this frame, px; wrong this often in a row, it is given up.
_WRONG_PX, _WRONG_FRAMES = 3.0, 3
# Frames in a row without an answer after which a new epoch starts.
_LOST_FRAMES = 3
# Depth of the first points: a bulge of this share of the radius towards the camera, known to this share.
_FIRST_BULGE, _FIRST_SIGMA = 0.5, 10.0
# Later points start at the depth of this many neighbours, known to this share of the relief.
_NEIGHBOURS, _NEIGHBOUR_SIGMA = 5, 10.0
_NEIGHBOUR_SOFTENING_PX = 5.0
# A camera that moves about a static scene, often in a hand, accelerates this much more than a body tumbling in space.
_CAMERA_AGILITY = 30.0
# Alternative solutions are tried every so many frames: the mirror image, and the CAD's when it disagrees this much.
_ALTERNATIVE_PERIOD = 5
_MIN_PRIOR_AGREEMENT = 0.7


class FeatureSlam:
    """Monocular motion relative to a rigid target (masked) or to a static scene (unmasked).

    Args:
        config: the whole configuration; ``slam.feature``, ``slam.masked`` and ``prior`` are used.
        target: the CAD model, for the depth that healthy priors bring; None = never use priors.
    """

    def __init__(self, config: HatConfig, target: Target | None) -> None:
        self._config, self._masked = config.slam.feature, config.slam.masked
        self._new_surface: Callable[[], SurfacePrior] | None = None
        # In a whole scene the target is a small part: its surface would tell little, and pull at everything.
        if target is not None and self._config.use_prior and self._masked:
            caster, radius_m = ray_caster(target), target.bounding_radius_m
            self._new_surface = partial(SurfacePrior, self._config, caster, radius_m, config.prior.delay_frames)
        self._number = 0
        self._epoch: _Epoch | None = None
        warm_up(self._config)
        depth_beside(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1))
        blank = np.ones((32, 32), np.uint8)
        detect(blank, blank, np.zeros((1, 2)), 1, self._config.spacing_px)

    def update(self, frame: Frame, detection: Detection | None, prior: PosePrior | None) -> Motion:
        """Advance by one frame.

        Args:
            frame: the frame, its background black when masked.
            detection: the mask; needed when masked.
            prior: fused poses of the past; used while healthy.

        Returns:
            ``T_slam_cam``; not valid when there is too little to go by.
        """
        region = self._region(frame, detection)
        if region is None:
            return Motion.none(self._number)
        if self._epoch is not None and not _same_camera(self._epoch.camera, frame.camera):
            self.reset()
        image = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        if self._epoch is None:
            self._epoch = self._started(frame, image, region)
            return Motion.none(self._number) if self._epoch is None else self._epoch.motion(self._number)
        if not self._epoch.advance(frame.stamp_ns, image, region, prior):
            if self._epoch.n_lost >= _LOST_FRAMES:
                self.reset()
            return Motion.none(self._number)
        return self._epoch.motion(self._number)

    def reset(self) -> None:
        """Start a new epoch, if the present one has begun."""
        if self._epoch is not None:
            self._number += 1
        self._epoch = None

    def _region(self, frame: Frame, detection: Detection | None) -> UInt8 | None:
        """(H, W) nonzero where points may lie; None when nothing is known of it."""
        if not self._masked:
            return np.ones(frame.rgb.shape[:2], np.uint8)
        return None if detection is None else detection.mask.view(np.uint8)

    def _started(self, frame: Frame, image: UInt8, region: UInt8) -> _Epoch | None:
        """The epoch that begins with a frame, if it shows enough points."""
        tracks = PointTracks(self._config.max_points, self._config.spacing_px)
        slots = tracks.replenish(image, region)
        if len(slots) < _MIN_POINTS:
            return None
        rows, cols = np.nonzero(region)
        center = normalise(frame.camera, np.array([cols.mean(), rows.mean()]))
        focal = float(np.sqrt(frame.camera.K[0, 0] * frame.camera.K[1, 1]))
        radius = float(np.sqrt(len(rows) / np.pi) / focal)
        agility = 1.0 if self._masked else _CAMERA_AGILITY
        window = Window(self._config, frame.stamp_ns, center, radius, focal, agility)
        z = np.ones(len(slots))
        if self._masked:
            z -= _FIRST_BULGE * radius * (bulge(region, tracks.xy[slots]) - 0.5)
        window.place(slots, normalise(frame.camera, tracks.xy[slots]), z, _FIRST_SIGMA * radius)
        surface = None if self._new_surface is None else self._new_surface()
        return _Epoch(self._config, self._masked, frame.camera, tracks, window, surface)


class _Epoch:
    """Tracks and window from one first frame on, which defines the gauge.

    Args:
        config: settings.
        masked: whether only a rigid target is seen.
        camera: of all frames.
        tracks: points of the first frame.
        window: with the first frame and its points.
        surface: the CAD model's prior, None = no prior.

    Attributes:
        n_lost: frames without an answer since the last one with.
    """

    def __init__(
        self,
        config: FeatureSlamConfig,
        masked: bool,
        camera: Camera,
        tracks: PointTracks,
        window: Window,
        surface: SurfacePrior | None,
    ) -> None:
        self._config, self._masked = config, masked
        self.camera = camera
        self._tracks, self._window, self._surface = tracks, window, surface
        self._n_wrong = np.zeros(config.max_points, dtype=np.int64)
        self._met_prior = False
        self.n_lost = 0
        if surface is not None:
            surface.remember(window, tracks.track_id)

    def advance(self, stamp_ns: int, image: UInt8, region: UInt8, prior: PosePrior | None) -> bool:
        """One frame more; False when the points do not tell where it was taken."""
        window, tracks = self._window, self._tracks
        tracks.advance(image, region, self._guess(stamp_ns))
        xn = normalise(self.camera, tracks.xy)
        R, t, residual_px = window.locate(stamp_ns, xn, tracks.alive)
        right = residual_px < _WRONG_PX
        if np.count_nonzero(right) < _MIN_POINTS:
            self.n_lost += 1
            return False
        self.n_lost = 0
        self._n_wrong = np.where(right, 0, self._n_wrong + 1)
        seen = tracks.alive.copy()
        tracks.alive &= self._n_wrong < _WRONG_FRAMES
        window.thin(tracks.alive)
        window.append(stamp_ns, R, t, xn, seen)
        if self._surface is not None:
            self._surface.remember(window, tracks.track_id)
            if prior is not None and prior.healthy:
                self._surface.expect(window, tracks.track_id, prior)
        window.adjust()
        self._try_alternatives(prior)
        window.emit()
        self._replenish(image, region)
        return True

    def motion(self, number: int) -> Motion:
        """The newest pose as it is given out, in the epoch of this number."""
        window = self._window
        T_slam_cam = lie.inverse(lie.transform(window.R_emitted[-1], window.t[-1]))
        sigma_rad = window.step_sigma_rad() if len(window) > 1 else 0.0
        if not sigma_rad <= np.radians(self._config.max_step_sigma_deg):
            return Motion.none(number, len(window))
        return Motion(True, number, lie.row_from_matrix(T_slam_cam), len(window), sigma_rad)

    def _try_alternatives(self, prior: PosePrior | None) -> None:
        """Now and then ask whether another solution, or another opinion of the prior, explains the tracks better."""
        window = self._window
        prior_known = np.count_nonzero(window.n_looks) >= _MIN_POINTS
        if prior_known and not self._met_prior:
            self._met_prior = True
            window.try_prior()
            return
        # A trusted CAD surface leaves little room for another solution, nor does the depth of a whole scene.
        certain = window.trusts_prior or not self._masked
        turn, phase = divmod(window.number[-1], _ALTERNATIVE_PERIOD * (2 if certain else 1))
        if phase == 0 and len(window) > 3:
            if window.trusts_prior and turn % 2 == 0:
                window.challenge_prior()
            elif prior is None or self._surface is None:
                window.challenge_structure()
            else:
                seen_turn = lie.so3_log(prior.T_cam_target[:3, :3] @ lie.matrix_from_row(prior.fused_row)[:3, :3].T)
                window.challenge_structure(prior.stamp_ns, seen_turn)
        elif phase == 2 and prior_known and window.prior_agreement() < _MIN_PRIOR_AGREEMENT:
            window.try_prior()

    def _guess(self, stamp_ns: int) -> Float:
        """(N, 2) expected pixel positions: where the points are now plus their predicted displacement."""
        window = self._window
        R, t = window.predict(stamp_ns)
        before = window.points_in_camera(window.R[-1], window.t[-1])
        after = window.points_in_camera(R, t)
        front = (before[:, 2] > 0) & (after[:, 2] > 0)
        before, after = np.where(front[:, None], before, 1.0), np.where(front[:, None], after, 1.0)
        return self._tracks.xy + self.camera.project(after) - self.camera.project(before)

    def _replenish(self, image: UInt8, region: UInt8) -> None:
        window, tracks = self._window, self._tracks
        known = np.flatnonzero(tracks.alive)
        slots = tracks.replenish(image, region)
        if not len(slots) or not len(known):
            return
        z = window.points_in_camera(window.R[-1], window.t[-1])[known, 2]
        z_new, relief = depth_beside(tracks.xy[slots], tracks.xy[known], z)
        sigma = _NEIGHBOUR_SIGMA * max(relief, 0.1 * window.radius)
        window.place(slots, normalise(self.camera, tracks.xy[slots]), z_new, sigma)
        self._n_wrong[slots] = 0


def normalise(camera: Camera, xy: Float) -> Float:
    """Normalised coordinates of pixels: (..., 2) -> (..., 2)."""
    K = camera.K
    y = (xy[..., 1] - K[1, 2]) / K[1, 1]
    return np.stack([(xy[..., 0] - K[0, 2] - K[0, 1] * y) / K[0, 0], y], axis=-1)


@njit(cache=True, nogil=True)
def depth_beside(xy: Float, xy_known: Float, z_known: Float) -> tuple[Float, float]:
    """Depth (n,) at (n, 2) pixels from the nearest of (m, 2) known ones (m,), and the relief: one sigma of these."""
    out = np.empty(len(xy))
    n_near = min(_NEIGHBOURS, len(xy_known))
    for i in range(len(xy)):
        distance_sq = (xy_known[:, 0] - xy[i, 0]) ** 2 + (xy_known[:, 1] - xy[i, 1]) ** 2
        total = depth = 0.0
        for _ in range(n_near):
            nearest = np.argmin(distance_sq)
            weight = 1.0 / (distance_sq[nearest] + _NEIGHBOUR_SOFTENING_PX**2)
            total += weight
            depth += weight * z_known[nearest]
            distance_sq[nearest] = np.inf
        out[i] = depth / total
    return out, 1.48 * float(np.median(np.abs(z_known - np.median(z_known))))


def bulge(region: UInt8, xy: Float) -> Float:
    """Height (n,) in [0, 1] of a cushion over the region at (n, 2) pixels: half a circle over the distance inwards."""
    inwards = cv2.distanceTransform(region, cv2.DIST_L2, 5)
    col, row = np.rint(xy).astype(int).T
    share = inwards[row, col].astype(np.float64) / max(float(inwards.max()), 1.0)
    return np.sqrt(1.0 - (1.0 - share) ** 2)


def _same_camera(a: Camera, b: Camera) -> bool:
    return a is b or ((a.width, a.height) == (b.width, b.height) and np.array_equal(a.K, b.K))
