"""Stage 3: causal Viterbi selection of one anchor among the hypotheses of a keyframe.

Paper, eqs. (appearance), (increment), (viterbi), (forward), (sizew). One score per current candidate is all that the
decoder carries from keyframe to keyframe, so cost and memory stay constant.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import Float
from hat_ros.config import SelectorConfig
from hat_ros.geometry import lie
from hat_ros.types import Candidates, Motion, Selection


class SelectorStage:
    """The decoder; one :meth:`update` per frame.

    Attributes:
        accepted: at the last keyframe the decoder's own proposal became the anchor: the warm-up was over and the
            running gate, if any, was open.
    """

    def __init__(self, config: SelectorConfig) -> None:
        self._config = config
        self.reset()

    def reset(self) -> None:
        """Forget all orientation histories; the next keyframe is the first."""
        self._previous: tuple[Candidates, NDArray[np.intp], Float, Motion] | None = None
        self._n_frames_since = 0
        self._n_keyframes = 0
        self._gate = RunningGate(self._config)
        self.accepted = False

    def update(self, candidates: Candidates, motion: Motion) -> Selection:
        """Choose the anchor of one frame.

        Args:
            candidates: hypotheses of this frame, in any order; ``-inf`` scores are dropped ones.
            motion: target-relative camera state of this frame.

        Returns:
            The selection; ``selected`` is -1 when the frame has no surviving candidate, and then the decoder does
            not advance.
        """
        self.accepted = False
        self._n_frames_since += 1
        if len(candidates) == 0:
            return Selection.none()
        scaled = scaled_score(candidates, self._config)
        alive = np.flatnonzero(np.isfinite(scaled))
        path = np.full(len(candidates), -np.inf)
        if len(alive) == 0:
            return Selection(candidates, scaled, path)

        path[alive] = scaled[alive] + self._best_history(candidates, alive, motion)
        # Only differences matter (eq. viterbi): keeping the largest at zero keeps precision over any length.
        path -= path.max()
        self._previous, self._n_frames_since = (candidates, alive, path[alive], motion), 0
        self._n_keyframes += 1

        proposal, best = int(np.argmax(path)), int(np.argmax(scaled))
        self._gate.observe(candidates, alive, best, proposal)
        self.accepted = self._n_keyframes >= self._config.warmup_keyframes and self._gate.open
        return Selection(candidates, scaled, path, proposal if self.accepted else best)

    def _best_history(self, candidates: Candidates, alive: NDArray[np.intp], motion: Motion) -> Float:
        """max_h [V_{j-1}(h) - mu d(R_{j,k}, Delta R_{j-1,h})] for every surviving k: (len(alive),)."""
        if self._previous is None:
            return np.zeros(len(alive))
        previous, previous_alive, previous_path, previous_motion = self._previous
        penalty = motion_penalty(
            previous, previous_alive, previous_motion, candidates, alive, motion, self._n_frames_since, self._config
        )
        return np.max(previous_path[None, :] - penalty, axis=1)


def motion_penalty(
    previous: Candidates,
    previous_alive: NDArray[np.intp],
    previous_motion: Motion,
    current: Candidates,
    current_alive: NDArray[np.intp],
    current_motion: Motion,
    n_frames: int,
    config: SelectorConfig,
) -> Float:
    """mu d(R_{j,k}, Delta R_{j-1,h}) between the survivors of two keyframes, ``n_frames`` apart: (k, h).

    Our extensions, both off as published: the penalty is at most ``max_motion_penalty``, since the true orientation
    need not have been among the earlier candidates, and then no evidence could ever make up for half a turn. And it is
    not zero without an increment, which would forget all history: there a turn counts as far as it exceeds
    ``max_turn_deg_per_frame``.
    """
    increment, free_deg = rotation_increment(previous_motion, current_motion), 0.0
    if increment is None:
        if config.max_turn_deg_per_frame == 0:
            return np.zeros((len(current_alive), len(previous_alive)))
        increment, free_deg = np.eye(3), config.max_turn_deg_per_frame * n_frames
    predicted = increment @ previous.T_cam_target[previous_alive, :3, :3]
    angle = lie.angle_between(current.T_cam_target[current_alive, None, :3, :3], predicted[None])
    penalty = config.motion_weight_per_deg * np.maximum(np.degrees(angle) - free_deg, 0.0)
    return np.minimum(penalty, config.max_motion_penalty) if config.max_motion_penalty > 0 else penalty


def scaled_score(candidates: Candidates, config: SelectorConfig) -> Float:
    """Appearance term of every candidate, eq. (appearance), or eq. (sizew) with size weighting: (K,), best is 0.

    A box of unknown size has unit weight. Dropped candidates stay at ``-inf``.
    """
    alive = np.isfinite(candidates.log_score)
    scaled = np.full(len(candidates), -np.inf)
    if not alive.any():
        return scaled
    scale = config.score_scale
    area_px = box_area_px(candidates.box_xyxy)
    if config.size_weighting and np.isfinite(area_px):
        size_weight = (np.sqrt(area_px) / config.size_ref_px) ** config.size_exponent
        scale *= min(max(size_weight, config.size_weight_min), 1.0)
    scaled[alive] = scale * (candidates.log_score[alive] - candidates.log_score[alive].max())
    return scaled


def box_area_px(box_xyxy: Float) -> float:
    """Area of a detection box in square pixels, NaN when there is none."""
    return float(max(box_xyxy[2] - box_xyxy[0], 0.0) * max(box_xyxy[3] - box_xyxy[1], 0.0))


def rotation_increment(previous: Motion, current: Motion) -> Float | None:
    """Delta^S = R_current^T R_previous, eq. (increment): (3, 3), or None when either is missing or epochs differ."""
    if not (previous.valid and current.valid) or previous.epoch != current.epoch:
        return None
    return current.T_slam_cam[:3, :3].T @ previous.T_slam_cam[:3, :3]


class RunningGate:
    """Trusts the decoder only while candidates support each other and it does not override appearance too often.

    Both figures run over all keyframes so far, this one included, warm-up keyframes included. The support is a small
    count, so a histogram gives its exact median in constant memory.
    """

    def __init__(self, config: SelectorConfig) -> None:
        self._config = config
        self._support_histogram = np.zeros(1, dtype=np.int64)
        self._n_overrides = 0
        self._n_keyframes = 0

    def observe(self, candidates: Candidates, alive: NDArray[np.intp], best: int, proposal: int) -> None:
        """Count one keyframe: the survivors near the best-appearance candidate, and whether the decoder overrode it."""
        if not self._config.running_gate:
            return
        R = candidates.T_cam_target[:, :3, :3]
        near = np.degrees(lie.angle_between(R[alive], R[best])) <= self._config.gate_neighbourhood_deg
        support = int(np.count_nonzero(near))
        if support >= len(self._support_histogram):
            self._support_histogram = np.pad(self._support_histogram, (0, support + 1 - len(self._support_histogram)))
        self._support_histogram[support] += 1
        self._n_overrides += proposal != best
        self._n_keyframes += 1

    @property
    def median_support(self) -> float:
        """Running median of the support; the mean of the middle two for an even number of keyframes."""
        cumulative = np.cumsum(self._support_histogram)
        middle = [(self._n_keyframes - 1) // 2, self._n_keyframes // 2]
        return float(np.mean(np.searchsorted(cumulative, middle, side="right")))

    @property
    def open(self) -> bool:
        """Whether the decoder's proposal may be used."""
        config = self._config
        return not config.running_gate or (
            self.median_support >= config.gate_min_median_support
            and self._n_overrides <= config.gate_max_override_share * self._n_keyframes
        )
