"""The window: recent and spread-out frames of one epoch, the points they see, and what is expected of both.

The SLAM frame is fixed to the target, its axes those of the first camera, its origin at the target's apparent centre,
its unit the distance at the start. Frames are kept ever more sparsely with age, because ten neighbours of a slow tumble
tell nothing about depth where sixty frames do (bas-relief ambiguity).
"""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Bool, Float, Int
from hat_ros.config import FeatureSlamConfig
from hat_ros.geometry import lie
from hat_ros.geometry.linear import robust_mean_rotation, turn_between
from hat_ros.motion.bundle import Problem, adjust_window, window_cost
from hat_ros.motion.reprojection import refine_pose

# Newest frames that are never thinned out.
_RECENT_FRAMES = 5
# Fewer live tracks than this tie a frame to the present no longer.
_MIN_SHARED_POINTS = 8
# Holds the oldest frame: one over this squared is far above the noise of a pose, far below what it must resist.
_GAUGE_INFO = 1e4
# Loss scale of the first rounds on a new frame, px: wide enough for a poor prediction.
_WIDE_CUTOFF_PX = 6.0
# How much looser than between frames of the window the prediction of a new pose is.
_PREDICTION_SLACK = 3.0
# One-sigma turn (rad) and move (radii) of a second frame, about which nothing is known.
_FIRST_TURN_RAD, _FIRST_MOVE_RADII = 0.35, 1.0
# The structure of an epoch younger than this is a guess, so its tracks cannot be told from outliers yet.
_YOUNG_FRAMES = 10
# What is given out catches up with what the window knows of this many frames, by this share of the difference.
_CATCH_UP_FRAMES, _CATCH_UP_SHARE = 8, 0.3
_YOUNG_CUTOFFS = (8.0, 4.0, 2.0)
# An alternative solution must be this much cheaper, relative and absolute, to take over.
_ALTERNATIVE_SHARE, _ALTERNATIVE_MARGIN = 0.9, 20.0
_ALTERNATIVE_ITERATIONS = 8
# Turn from which its direction is beyond doubt, and how much of it two opinions that agree may differ by.
_TELLING_TURN_RAD, _AGREEING_SHARE = np.radians(0.8), 0.75
# A prior is dropped when the cost without it is lower by this much per observation and is this share of the cost with
# it; it comes back when it costs less than this more. Right priors of 3 degrees noise stay at half the gain.
_DISTRUST_GAIN, _DISTRUST_SHARE = 0.04, 0.7
_TRUST_LOSS, _TRUST_SHARE = 0.03, 0.9
# Nearest depth (units) that a reversed relief is made from.
_MIN_MIRROR_DEPTH = 0.05


class Window:
    """State of one epoch.

    Args:
        config: settings.
        stamp_ns: first frame.
        center_xn: (2,) normalised image coordinates of the target's centre.
        radius: apparent radius of the target in normalised coordinates, equal to SLAM units at the start.
        focal: pixels per unit of normalised coordinates.
        agility: factor on the accelerations of the constant-rate prior.

    Attributes:
        stamps_ns, number: of the W frames, oldest first; ``number`` counts frames of the epoch.
        R, t: (W, 3, 3), (W, 3) poses ``p_cam = R p_slam + t``.
        xn, seen: (W, N, 2), (W, N) normalised observations and which of them exist.
        X: (N, 3) points. X_guess, guess_info: where their neighbours put them, and how firmly (1/unit^2).
        X_surface, surface_info: (N, 3), (N,) where the CAD surface puts them after n_looks (N,) looks,
            the last one from the frame look_stamp_ns.
        R_fused, fused_info: (W, 3, 3), (W,) rotations that fused poses suggest.
        R_emitted: (W, 3, 3) rotations as they were given out.
        trusts_prior: whether the adjustment uses the CAD surface and fused rotations.
        cost: of the last adjustment; covariance: (12, 12) of the last two poses.
    """

    def __init__(
        self,
        config: FeatureSlamConfig,
        stamp_ns: int,
        center_xn: Float,
        radius: float,
        focal: float,
        agility: float = 1.0,
    ) -> None:
        n = config.max_points
        self._config = config
        self.radius = radius
        self.focal = focal
        self.stamps_ns = [stamp_ns]
        self.number = [0]
        self.R = np.eye(3)[None].copy()
        self.t = np.array([[center_xn[0], center_xn[1], 1.0]])
        self.xn = np.zeros((1, n, 2))
        self.seen = np.zeros((1, n), dtype=bool)
        self.X = np.zeros((n, 3))
        self.X_guess = np.zeros((n, 3))
        self.guess_info = np.zeros(n)
        self.X_surface = np.zeros((n, 3))
        self.surface_info = np.zeros(n)
        self.n_looks = np.zeros(n, dtype=np.int64)
        self.R_fused = np.eye(3)[None].copy()
        self.fused_info = np.zeros(1)
        self.R_emitted = np.eye(3)[None].copy()
        self.trusts_prior = False
        self.look_stamp_ns = stamp_ns
        # Standard deviations of the accelerations, rad/s^2 and units/s^2.
        self._acceleration = agility * np.array(
            [np.radians(config.turn_acceleration_deg_s2), config.move_acceleration_radii_s2 * radius]
        )
        self.cost = 0.0
        self.covariance = np.full((12, 12), np.inf)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def points_in_camera(self, R: Float, t: Float) -> Float:
        """(N, 3) points in the camera of a pose."""
        return self.X @ R.T + t

    def predict(self, stamp_ns: int) -> tuple[Float, Float]:
        """Pose at a later stamp at constant rate: R (3, 3), t (3,)."""
        if len(self) < 2:
            return self.R[-1].copy(), self.t[-1].copy()
        ahead = (stamp_ns - self.stamps_ns[-1]) / (self.stamps_ns[-1] - self.stamps_ns[-2])
        turn = turn_between(self.R[-1], self.R[-2])
        return lie.so3_exp(ahead * turn) @ self.R[-1], self.t[-1] + ahead * (self.t[-1] - self.t[-2])

    def locate(self, stamp_ns: int, xn: Float, use: Bool) -> tuple[Float, Float, Float]:
        """Pose of a new frame from the points known: R, t and (N,) residuals in pixels, infinite where unused.

        Args:
            stamp_ns: its stamp.
            xn: (N, 2) normalised observations; use: (N,) which of them exist.
        """
        R0, t0 = self.predict(stamp_ns)
        dt = (stamp_ns - self.stamps_ns[-1]) * 1e-9
        if len(self) < 2:
            turn, move = _FIRST_TURN_RAD, _FIRST_MOVE_RADII * self.radius
        else:
            turn, move = _PREDICTION_SLACK * self._acceleration * dt * dt
        R, t = R0, t0
        for cutoff_px in (_WIDE_CUTOFF_PX, self._config.cutoff_px):
            R, t, residual_px = refine_pose(
                R, t, self.X, xn, use, self.focal, self._config.sigma_px, cutoff_px, R0, t0, turn**-2, move**-2, 4
            )
        return R, t, residual_px

    def append(self, stamp_ns: int, R: Float, t: Float, xn: Float, seen: Bool) -> None:
        """Add a frame: its pose, (N, 2) observations and which of them exist."""
        self.stamps_ns.append(stamp_ns)
        self.number.append(self.number[-1] + 1)
        self.R, self.t = np.concatenate([self.R, R[None]]), np.concatenate([self.t, t[None]])
        self.xn, self.seen = np.concatenate([self.xn, xn[None]]), np.concatenate([self.seen, seen[None]])
        self.R_fused = np.concatenate([self.R_fused, R[None]])
        self.fused_info = np.append(self.fused_info, 0.0)
        self.R_emitted = np.concatenate([self.R_emitted, R[None]])

    def place(self, slots: Int, xn: Float, z: Float, sigma: float) -> None:
        """New points in slots, seen by the newest frame at (n, 2) with expected depth (n,) +- sigma."""
        in_camera = np.concatenate([xn, np.ones((len(xn), 1))], axis=1) * z[:, None]
        self.X[slots] = self.X_guess[slots] = (in_camera - self.t[-1]) @ self.R[-1]
        self.guess_info[slots] = sigma**-2
        self.n_looks[slots] = 0
        self.seen[:, slots] = False
        self.seen[-1, slots] = True
        self.xn[-1, slots] = xn

    def thin(self, alive: Bool) -> None:
        """Make room for a frame: drop the oldest once nothing ties it to the present, else the most crowded."""
        span = self._config.window_span_frames
        while len(self) > 3 and (
            np.count_nonzero(self.seen[0] & alive) < _MIN_SHARED_POINTS or self.number[-1] - self.number[0] > span
        ):
            self._remove(0)
        if len(self) >= self._config.window_frames:
            now = self.number[-1] + 1
            gap = [
                (self.number[k + 1] - self.number[k - 1]) / (now - self.number[k])
                for k in range(1, len(self) - _RECENT_FRAMES)
            ]
            self._remove(1 + int(np.argmin(gap)))

    def _remove(self, k: int) -> None:
        keep = np.arange(len(self)) != k
        for name in ("R", "t", "xn", "seen", "R_fused", "fused_info", "R_emitted"):
            setattr(self, name, getattr(self, name)[keep])
        del self.stamps_ns[k], self.number[k]

    def adjust(self) -> None:
        """Bundle-adjust the window; while it is young, from a wide loss to a narrow one."""
        state, problem = (self.R, self.t, self.X), self._problem(self.trusts_prior)
        # A trusted surface has settled the structure: the last step would find little to do.
        n_iterations = max(1, self._config.iterations - self.trusts_prior)
        self.cost, self.covariance = self._descend(state, problem, n_iterations)

    def challenge_structure(self, since_ns: int = -1, turn: Float | None = None) -> None:
        """Let the depth-reversed solution take over if it explains the tracks better, or as well and the turn better.

        Seen from afar, a relief turning one way and its mirror image turning the other way look the same (Necker
        reversal); only perspective and expected points tell them apart, and the descent cannot cross over. Where the
        tracks leave it open, fused poses that are not TRACKING may still know which way the target turns.

        Args:
            since_ns: stamp of a frame of the window.
            turn: (3,) rotation vector of the target in the camera frame from then to the newest frame as fused poses
                have it, None without them.
        """
        k = len(self) // 2
        in_camera = self.points_in_camera(self.R[k], self.t[k])
        nearness = 1.0 / np.maximum(in_camera[:, 2], _MIN_MIRROR_DEPTH)
        center = float(np.median(nearness[self._observed()]))
        # Reversed in inverse depth: to first order the motion of the image is linear in it.
        z = 1.0 / np.clip(2.0 * center - nearness, 0.2 * center, 5.0 * center)
        X = (in_camera * (z * nearness)[:, None] - self.t[k]) @ self.R[k]
        R, t = self._poses_for(X, self._observed(), k)
        # Guesses were made in the spirit of the solution: they turn with it.
        problem = self._problem(False)._replace(X_expected=X.copy())
        cost, _ = self._descend((R, t, X), problem, _ALTERNATIVE_ITERATIONS)
        if self.trusts_prior:
            # Freed of the prior any structure fits better: the reversed one must beat the present one as free as it is.
            present = self.R.copy(), self.t.copy(), self.X.copy()
            present_cost, _ = self._descend(present, self._problem(False), _ALTERNATIVE_ITERATIONS)
            if cost < _ALTERNATIVE_SHARE * present_cost - _ALTERNATIVE_MARGIN:
                self._distrust_for((R, t, X), cost)
            return
        is_better = cost < _ALTERNATIVE_SHARE * self.cost - _ALTERNATIVE_MARGIN
        is_as_good = cost < self.cost / _ALTERNATIVE_SHARE + _ALTERNATIVE_MARGIN
        if is_better or (is_as_good and turn is not None and self._turns_better(R, since_ns, turn)):
            self.R, self.t, self.X, self.X_guess = R, t, X, X.copy()

    def _turns_better(self, R: Float, since_ns: int, turn: Float) -> bool:
        """Whether other rotations (W, 3, 3) clearly agree with an expected turn and the present ones clearly do not."""
        size = float(np.linalg.norm(turn))
        if since_ns not in self.stamps_ns or size < _TELLING_TURN_RAD:
            return False
        k = self.stamps_ns.index(since_ns)
        present, other = (np.linalg.norm(turn_between(Q[-1], Q[k]) - turn) / size for Q in (self.R, R))
        return bool(other < _AGREEING_SHARE and present > 2.0 * _AGREEING_SHARE)

    def challenge_prior(self) -> None:
        """Stop trusting the prior if the tracks are explained much better without it."""
        state = self.R.copy(), self.t.copy(), self.X.copy()
        cost, _ = self._descend(state, self._problem(False), _ALTERNATIVE_ITERATIONS)
        self._distrust_for(state, cost)

    def _distrust_for(self, state: tuple[Float, Float, Float], cost: float) -> None:
        present = self._free_cost(self.R, self.t, self.X)
        if present - cost > _DISTRUST_GAIN * np.count_nonzero(self.seen) and cost < _DISTRUST_SHARE * present:
            self.R, self.t, self.X = state
            self.X_guess = self.X.copy()
            self.trusts_prior = False

    def try_prior(self) -> None:
        """Take the structure that the prior suggests, and trust it, if it explains the tracks about as well."""
        known = self.n_looks > 0
        X = np.where(known[:, None], self.X_surface, self.X)
        first = int(np.argmin(np.abs(np.array(self.stamps_ns, dtype=np.int64) - self.look_stamp_ns)))
        R, t = self._poses_for(X, known, first)
        self._descend((R, t, X), self._problem(True)._replace(R_info=np.zeros(len(self))), _ALTERNATIVE_ITERATIONS)
        present = self._free_cost(self.R, self.t, self.X)
        allowed = max(present / _TRUST_SHARE, present + _TRUST_LOSS * np.count_nonzero(self.seen))
        if self._free_cost(R, t, X) < allowed:
            self.R, self.t, self.X = R, t, X
            self.trusts_prior = True

    def prior_agreement(self) -> float:
        """Share of the points in use that lie where the prior expects them (two sigmas); 0 while it is not trusted."""
        if not self.trusts_prior:
            return 0.0
        known = self._observed() & (self.n_looks > 0)
        if np.count_nonzero(known) < _MIN_SHARED_POINTS:
            return 1.0
        offset = np.linalg.norm(self.X[known] - self.X_surface[known], axis=1) * np.sqrt(self.surface_info[known])
        return float(np.mean(offset < 2.0))

    def emit(self) -> None:
        """Fix the newest rotation as it is given out: the last one turned by the best increment known now.

        What the window has since learned about the increments before is made good, little by little, and never by
        more than a step's own uncertainty.
        """
        chained = self.R[-1] @ self.R[-2].T @ self.R_emitted[-2]
        recent = [k for k in range(len(self) - 2) if self.number[-1] - self.number[k] <= _CATCH_UP_FRAMES]
        if recent:
            owed = np.mean(
                [turn_between(self.R[-1] @ self.R[k].T @ self.R_emitted[k], chained) for k in recent], axis=0
            )
            size = float(np.linalg.norm(owed))
            chained = lie.so3_exp(owed * min(_CATCH_UP_SHARE, self.step_sigma_rad() / max(size, 1e-12))) @ chained
        self.R_emitted[-1] = chained

    def step_sigma_rad(self) -> float:
        """One-sigma angle of the turn from the last frame but one to the last; infinite while nothing is known."""
        if not np.isfinite(self.covariance).all():
            return float("inf")
        # Of d_1 - A d_0, where A turns one frame's errors into the other's: the trace needs no product but one.
        A, C = self.R[-1] @ self.R[-2].T, self.covariance
        return float(np.sqrt(np.trace(C[:3, :3]) + np.trace(C[6:9, 6:9]) - 2.0 * np.sum(A * C[6:9, :3])))

    def _observed(self) -> Bool:
        """(N,) which points any frame of the window sees."""
        observed: Bool = np.any(self.seen, axis=0)
        return observed

    def _poses_for(self, X: Float, known: Bool, first: int) -> tuple[Float, Float]:
        """Poses (W, 3, 3), (W, 3) of all frames from other points (N, 3), those that are known.

        Outwards from a frame whose pose is kept as a start, each from its neighbour: the present poses may be far off.
        """
        R, t = self.R.copy(), self.t.copy()
        for k in [*range(first, len(self)), *range(first - 1, -1, -1)]:
            use = self.seen[k] & known
            near = k if k == first else k - 1 if k > first else k + 1
            R[k], t[k] = R[near], t[near]
            if np.count_nonzero(use) < _MIN_SHARED_POINTS:
                continue
            for cutoff_px in (4 * _WIDE_CUTOFF_PX, _WIDE_CUTOFF_PX):
                R[k], t[k], _ = refine_pose(
                    R[k], t[k], X, self.xn[k], use, self.focal, self._config.sigma_px, cutoff_px, R[k], t[k],
                    1.0, 1.0, 6,
                )  # fmt: skip
        return R, t

    def _descend(self, state: tuple[Float, Float, Float], problem: Problem, n_iterations: int) -> tuple[float, Float]:
        R, t, X = state
        # Another solution has its own gauge: held at the present one's oldest frame it could not differ.
        problem = problem._replace(R_gauge=R[0].copy(), t_gauge=t[0].copy())
        if self.number[-1] <= _YOUNG_FRAMES:
            for factor in _YOUNG_CUTOFFS:
                adjust_window(R, t, X, problem._replace(cutoff_px=factor * problem.cutoff_px), n_iterations)
        return adjust_window(R, t, X, problem, n_iterations)

    def _free_cost(self, R: Float, t: Float, X: Float) -> float:
        """Cost of a solution in its own gauge, whatever the prior says."""
        return window_cost(R, t, X, self._problem(False)._replace(R_gauge=R[0], t_gauge=t[0]))

    def _problem(self, with_prior: bool) -> Problem:
        seconds = (np.array(self.stamps_ns, dtype=np.int64) - self.stamps_ns[0]) * 1e-9
        dt = np.concatenate([[1.0], seconds[1:] - seconds[:-1]])
        rate_info = np.zeros((len(self), 2))
        span = 0.5 * (dt[1:-1] + dt[2:])
        rate_info[1:-1] = (self._acceleration * span[:, None]) ** -2
        known = (self.n_looks > 0) & with_prior
        return Problem(
            xn=self.xn,
            seen=self.seen,
            focal=self.focal,
            sigma_px=self._config.sigma_px,
            cutoff_px=self._config.cutoff_px,
            X_expected=np.where(known[:, None], self.X_surface, self.X_guess),
            X_info=np.where(known, self.surface_info, self.guess_info),
            R_expected=self.R_fused,
            R_info=self.fused_info * with_prior,
            dt=dt,
            rate_info=rate_info,
            R_gauge=self.R[0].copy(),
            t_gauge=self.t[0].copy(),
            gauge_info=_GAUGE_INFO,
        )


def warm_up(config: FeatureSlamConfig) -> None:
    """Put a made-up window through everything that is compiled.

    The first use compiles for many seconds on a new machine: the set-up of a stage has time for that, a frame has not.
    """
    n = min(2 * _MIN_SHARED_POINTS, config.max_points)
    xn, seen = np.zeros((config.max_points, 2)), np.arange(config.max_points) < n
    angle = np.arange(n)
    xn[:n] = 0.05 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    window = Window(config, 0, np.zeros(2), 0.1, 1000.0)
    window.place(np.arange(n), xn[:n], 1.0 + 0.01 * np.cos(3.0 * angle), 0.1)
    R, t, _ = window.locate(100_000_000, xn, seen)
    window.append(100_000_000, R, t, xn, seen)
    window.predict(200_000_000)
    window.adjust()
    window.challenge_prior()
    window.emit()
    robust_mean_rotation(window.R, 1.0)
