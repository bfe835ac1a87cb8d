"""What fused poses of the past tell about the window: depths on the CAD surface, and rotations.

Depth is used relative to the median depth of the same frame, so a prior changes neither gauge nor scale of the SLAM
frame by more than a slow pull that keeps the scale from drifting. Rotations count up to one common turn. Both enter
the adjustment with a redescending loss: a prior in the wrong basin that contradicts the tracks loses its weight.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from hat_ros.array_types import Float, Int
from hat_ros.config import FeatureSlamConfig
from hat_ros.geometry import lie
from hat_ros.geometry.linear import robust_mean_rotation
from hat_ros.motion.window import Window
from hat_ros.target.rays import RayCaster
from hat_ros.types import PosePrior

# Depth is sampled here, px: the spread over the cross is what a misplaced silhouette or edge could cost.
_CROSS_PX = np.array([[0.0, 0.0], [3.0, 0.0], [-3.0, 0.0], [0.0, 3.0], [0.0, -3.0]])
_MIN_HITS = 3
_MIN_POINTS = 6
# Expected points average this many looks at the surface, then forget exponentially.
_MEAN_OF_LOOKS = 8
# A new point with fewer observations than this starts on the surface.
_FRESH_OBSERVATIONS = 6
# Share by which a prior's scale is pulled to the scale of the first one.
_SCALE_PULL = 0.2
# Scale of the loss in the mean of the gauge, radians (3 degrees).
_GAUGE_CUTOFF_RAD = 0.05
_MIN_ROTATIONS = 3


@dataclass(frozen=True)
class _Past:
    stamp_ns: int
    xn: Float
    track_id: Int
    R: Float
    t: Float


class SurfacePrior:
    """Turns priors into expectations of a window.

    Args:
        config: settings.
        caster: of the CAD model, which takes too long to build for a first frame.
        bounding_radius_m: of the same.
        delay_frames: how many frames back the youngest prior lies.
    """

    def __init__(
        self, config: FeatureSlamConfig, caster: RayCaster, bounding_radius_m: float, delay_frames: int
    ) -> None:
        self._config = config
        self._caster = caster
        self._sigma_m = config.surface_sigma * bounding_radius_m
        self._past: deque[_Past] = deque(maxlen=delay_frames + 2)
        self._rotation: dict[int, Float] = {}
        self._units_per_m: float | None = None

    def remember(self, window: Window, track_id: Int) -> None:
        """Keep the newest frame's observations until its fused pose arrives."""
        seen = window.seen[-1]
        self._past.append(
            _Past(window.stamps_ns[-1], window.xn[-1].copy(), np.where(seen, track_id, -1), window.R[-1], window.t[-1])
        )

    def expect(self, window: Window, track_id: Int, prior: PosePrior) -> bool:
        """Let the prior move the window's expectations; returns whether it did."""
        past = next((past for past in self._past if past.stamp_ns == prior.stamp_ns), None)
        if past is None or prior.stamp_ns in self._rotation:
            return False
        T_cam_target = lie.matrix_from_row(prior.fused_row)
        self._rotation[prior.stamp_ns] = T_cam_target[:3, :3]
        for stamp in [stamp for stamp in self._rotation if stamp < window.stamps_ns[0]]:
            del self._rotation[stamp]
        self._expect_rotations(window)
        slots = np.flatnonzero((past.track_id >= 0) & (past.track_id == track_id))
        z_m, sigma_m = self._depth(T_cam_target, past.xn[slots], window.focal)
        hit = np.isfinite(z_m)
        if np.count_nonzero(hit) < _MIN_POINTS:
            return False
        self._expect_points(window, past, slots[hit], z_m[hit], sigma_m[hit])
        return True

    def _depth(self, T_cam_target: Float, xn: Float, focal: float) -> tuple[Float, Float]:
        """Depth (n,) in metres of the surface at (n, 2) normalised coordinates, NaN = miss, and its sigma (n,)."""
        uv = xn[:, None] + _CROSS_PX / focal
        rays = np.concatenate([uv, np.ones((*uv.shape[:2], 1))], axis=-1).reshape(-1, 3) @ T_cam_target[:3, :3]
        origin = -T_cam_target[:3, 3] @ T_cam_target[:3, :3]
        hits = self._caster.trace(np.broadcast_to(origin, rays.shape), rays)
        z = hits.distance.astype(np.float64).reshape(-1, len(_CROSS_PX))
        hit = (hits.face >= 0).reshape(z.shape)
        spread = np.where(hit, z, -np.inf).max(axis=1) - np.where(hit, z, np.inf).min(axis=1)
        known = hit[:, 0] & (np.count_nonzero(hit, axis=1) >= _MIN_HITS)
        return np.where(known, z[:, 0], np.nan), self._sigma_m + 0.5 * np.where(known, spread, 0.0)

    def _expect_points(self, window: Window, past: _Past, slots: Int, z_m: Float, sigma_m: Float) -> None:
        R, t = past.R, past.t
        if past.stamp_ns in window.stamps_ns:  # adjusted since
            k = window.stamps_ns.index(past.stamp_ns)
            R, t = window.R[k], window.t[k]
        scale = float(np.median(window.points_in_camera(R, t)[slots, 2] / z_m))
        if self._units_per_m is None or not window.trusts_prior:
            self._units_per_m = scale
            # Poses of an untrusting window may contradict the surface: one look alone is consistent with itself.
            window.n_looks[:] = 0
        scale *= (self._units_per_m / scale) ** _SCALE_PULL
        rays = np.concatenate([past.xn[slots], np.ones((len(slots), 1))], axis=1)
        points = (rays * (scale * z_m)[:, None] - t) @ R
        window.look_stamp_ns = past.stamp_ns
        new = window.n_looks[slots] == 0
        window.n_looks[slots] += 1
        share = (1.0 / np.minimum(window.n_looks[slots], _MEAN_OF_LOOKS))[:, None]
        window.X_surface[slots] += share * (points - window.X_surface[slots])
        window.surface_info[slots] = (scale * sigma_m) ** -2
        if window.trusts_prior:
            fresh = new & (np.count_nonzero(window.seen[:, slots], axis=0) < _FRESH_OBSERVATIONS)
            window.X[slots[fresh]] = points[fresh]

    def _expect_rotations(self, window: Window) -> None:
        """Fused rotations of window frames, up to the common turn that brings them nearest to the window's."""
        window.fused_info[:] = 0.0
        frames = [k for k, stamp in enumerate(window.stamps_ns) if stamp in self._rotation]
        if len(frames) < _MIN_ROTATIONS:
            return
        R_cam_target = np.stack([self._rotation[window.stamps_ns[k]] for k in frames])
        R_target_slam = robust_mean_rotation(np.swapaxes(R_cam_target, 1, 2) @ window.R[frames], _GAUGE_CUTOFF_RAD)
        window.R_fused[frames] = R_cam_target @ R_target_slam
        window.fused_info[frames] = np.radians(self._config.prior_turn_sigma_deg) ** -2
