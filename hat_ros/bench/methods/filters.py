"""Continuous-state filters in the place of the discrete decoder, as the paper compares them with it.

Both see what Stage 3 sees (candidates with scaled appearance scores, SLAM increments) and answer with a candidate
index, so everything downstream stays the same.

* :class:`ParticleSelector`: particles on SO(3), which can hold several orientation basins at once.
* :class:`UkfSelector`: one Gaussian in the tangent space of a mean rotation, with sigma points (Hauberg, Lauze,
  Pedersen, "Unscented Kalman filtering on Riemannian manifolds", J. Math. Imaging and Vision 46, 2013).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from hat_ros.array_types import Float
from hat_ros.config import SelectorConfig
from hat_ros.core.selector import rotation_increment, scaled_score
from hat_ros.geometry import lie
from hat_ros.types import Candidates, Motion, Selection


@dataclass(frozen=True)
class FilterNoise:
    """Settings of both filters.

    Attributes:
        motion_deg: one-sigma of the SLAM increment from keyframe to keyframe, per axis.
        lost_motion_deg: the same when no increment is known.
        candidate_deg: one-sigma of a candidate about the true rotation, per axis.
        outlier_share: probability that no candidate is right.
        particles: number of particles.
        seed: of the particles' random numbers.
    """

    motion_deg: float = 2.0
    lost_motion_deg: float = 30.0
    candidate_deg: float = 5.0
    outlier_share: float = 0.05
    particles: int = 2000
    seed: int = 0


class _FilterSelector(ABC):
    """What both filters share: book-keeping around one prediction and one update per keyframe."""

    def __init__(self, config: SelectorConfig, noise: FilterNoise | None = None) -> None:
        self._config = config
        self._noise = noise or FilterNoise()
        self._previous_motion = Motion.none()
        self._started = False

    def update(self, candidates: Candidates, motion: Motion) -> Selection:
        """Choose a candidate; no answer, and no step of the filter, without candidates."""
        alive = np.flatnonzero(np.isfinite(candidates.log_score))
        if len(alive) == 0:
            return Selection.none()
        scaled = scaled_score(candidates, self._config)
        R = candidates.T_cam_target[alive, :3, :3]
        if self._started:
            self._predict(rotation_increment(self._previous_motion, motion))
            support = self._correct(R, scaled[alive])
        else:
            self._start(R, scaled[alive])
            self._started = True
            support = scaled[alive]
        self._previous_motion = motion
        path_score = np.full(len(candidates), -np.inf)
        path_score[alive] = support - support.max()
        return Selection(candidates, scaled, path_score, int(alive[np.argmax(support)]))

    @abstractmethod
    def _start(self, R: Float, log_weight: Float) -> None:
        """Begin with the first candidates (n, 3, 3) and their scaled scores (n,)."""

    @abstractmethod
    def _predict(self, increment: Float | None) -> None:
        """Turn the state by an increment (3, 3), or spread it when none is known."""

    @abstractmethod
    def _correct(self, R: Float, log_weight: Float) -> Float:
        """Update with the candidates; returns the log-support of each."""


class ParticleSelector(_FilterSelector):
    """Bootstrap particle filter; the candidate with the most particle mass around it is chosen."""

    def _start(self, R: Float, log_weight: Float) -> None:
        self._rng = np.random.default_rng(self._noise.seed)
        chosen = self._rng.choice(len(R), size=self._noise.particles, p=_softmax(log_weight))
        self._R = self._jitter(R[chosen], self._noise.candidate_deg)
        self._weight = np.full(self._noise.particles, 1.0 / self._noise.particles)

    def _predict(self, increment: Float | None) -> None:
        if increment is None:
            self._R = self._jitter(self._R, self._noise.lost_motion_deg)
        else:
            self._R = self._jitter(increment @ self._R, self._noise.motion_deg)

    def _correct(self, R: Float, log_weight: Float) -> Float:
        angle = lie.angle_between(self._R[:, None], R[None])
        near = np.exp(-0.5 * (angle / np.radians(self._noise.candidate_deg)) ** 2)
        likelihood = near @ _softmax(log_weight) + self._noise.outlier_share / len(R)
        self._weight = self._weight * likelihood
        self._weight /= self._weight.sum()
        support = np.log(self._weight @ near + 1e-300)
        if 1.0 / np.sum(self._weight**2) < 0.5 * len(self._weight):
            self._resample()
        return support

    def _resample(self) -> None:
        """Systematic resampling."""
        positions = (self._rng.random() + np.arange(len(self._weight))) / len(self._weight)
        index = np.minimum(np.searchsorted(np.cumsum(self._weight), positions), len(self._weight) - 1)
        self._R = self._R[index]
        self._weight = np.full(len(self._weight), 1.0 / len(self._weight))

    def _jitter(self, R: Float, sigma_deg: float) -> Float:
        return lie.so3_exp(np.radians(sigma_deg) * self._rng.standard_normal((len(R), 3))) @ R


class UkfSelector(_FilterSelector):
    """Unscented filter of one rotation; the candidate with the best appearance and innovation is the measurement."""

    def _start(self, R: Float, log_weight: Float) -> None:
        self._mean = R[int(np.argmax(log_weight))]
        self._covariance = np.eye(3) * np.radians(self._noise.candidate_deg) ** 2

    def _predict(self, increment: Float | None) -> None:
        sigma_deg = self._noise.lost_motion_deg if increment is None else self._noise.motion_deg
        step = np.eye(3) if increment is None else increment
        points = step @ (lie.so3_exp(self._sigma_points()) @ self._mean)
        self._mean, self._covariance = _moments(points)
        self._covariance += np.eye(3) * np.radians(sigma_deg) ** 2

    def _correct(self, R: Float, log_weight: Float) -> Float:
        measurement_noise = np.eye(3) * np.radians(self._noise.candidate_deg) ** 2
        spread = self._sigma_points()
        innovation_covariance = _covariance_of(spread, spread) + measurement_noise
        innovation = lie.so3_log(R @ self._mean.T)
        inverse = np.linalg.inv(innovation_covariance)
        support = log_weight - 0.5 * np.einsum("ki,ij,kj->k", innovation, inverse, innovation)
        chosen = int(np.argmax(support))
        gain = _covariance_of(spread, spread) @ inverse
        self._mean = lie.so3_exp(gain @ innovation[chosen]) @ self._mean
        self._covariance = self._covariance - gain @ innovation_covariance @ gain.T
        return support

    def _sigma_points(self) -> Float:
        """(7, 3) tangent vectors: zero and plus-minus sqrt(3) times the columns of the square root."""
        root = np.linalg.cholesky(0.5 * (self._covariance + self._covariance.T) + 1e-15 * np.eye(3))
        return np.vstack([np.zeros(3), np.sqrt(3.0) * root.T, -np.sqrt(3.0) * root.T])


# Weights of the seven sigma points for a scaling of sqrt(3): the centre has none.
_SIGMA_WEIGHT = np.array([0.0, *([1.0 / 6.0] * 6)])


def _covariance_of(a: Float, b: Float) -> Float:
    return np.einsum("n,ni,nj->ij", _SIGMA_WEIGHT, a, b)


def _moments(points: Float) -> tuple[Float, Float]:
    """Intrinsic mean and covariance of seven rotations with the sigma weights."""
    mean = points[0]
    for _ in range(10):
        offset = _SIGMA_WEIGHT @ lie.so3_log(points @ mean.T)
        mean = lie.so3_exp(offset) @ mean
        if np.linalg.norm(offset) < 1e-12:
            break
    deviation = lie.so3_log(points @ mean.T)
    return mean, _covariance_of(deviation, deviation)


def _softmax(log_weight: Float) -> Float:
    weight = np.exp(log_weight - log_weight.max())
    return weight / weight.sum()
