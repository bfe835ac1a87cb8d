"""Fused poses of the past as a hint for the front ends, independent of timing.

Only estimates of frames ``t - delay_frames`` and earlier are ever used, found by exact stamp, however many newer ones
have already arrived: so the answer is the same in one process and in five.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import cache

import numpy as np

from hat_ros.array_types import Float, Int
from hat_ros.config import PriorConfig
from hat_ros.geometry import lie
from hat_ros.types import Estimate, PosePrior, TrackState

# Past poses behind one extrapolation: enough for the medians, short enough for a constant rate.
HISTORY_FRAMES = 8
# No target turns further from one frame to the next: it is a reset, as anchors only replace a track from beyond the
# gate (D, 30 degrees).
JUMP_DEG = 25.0
# Frames that a stage may have admitted beyond the one it asks about; they must not push history out.
_IN_FLIGHT_FRAMES = 64


class PriorBuffer:
    """Numbers admitted frames and answers what the fused past says about the newest.

    Every stage that wants priors owns one: it admits each frame in order and pushes each estimate as it arrives.
    """

    def __init__(self, config: PriorConfig) -> None:
        self._config = config
        self.reset()

    def reset(self) -> None:
        """Forget all frames and estimates."""
        self._frames: OrderedDict[int, Estimate | None] = OrderedDict()

    def admit(self, stamp_ns: int) -> None:
        """Number a frame; stamps come strictly increasing, a known one is ignored."""
        if not self._config.enabled or stamp_ns in self._frames:
            return
        self._frames[stamp_ns] = None
        while len(self._frames) > self._config.delay_frames + HISTORY_FRAMES + _IN_FLIGHT_FRAMES:
            self._frames.popitem(last=False)

    def push(self, estimate: Estimate) -> None:
        """Store the estimate of an admitted frame; one of an unknown or long-gone frame is ignored."""
        if estimate.stamp_ns in self._frames:
            self._frames[estimate.stamp_ns] = estimate

    def ready(self, stamp_ns: int) -> bool:
        """Whether every estimate that :meth:`before` would look at has arrived; the frame must have been admitted."""
        return all(estimate is not None for estimate in self._past(stamp_ns).values())

    def drop_unanswered(self, stamp_ns: int) -> None:
        """Forget the frames that :meth:`before` would look at and find without an estimate: they were given up."""
        while lost := [stamp for stamp, estimate in self._past(stamp_ns).items() if estimate is None]:
            for stamp in lost:
                del self._frames[stamp]

    def before(self, stamp_ns: int) -> PosePrior | None:
        """Prior of a frame (admitted here if it is new), extrapolated at constant rate.

        None when priors are disabled, before there are enough frames, and when the frame ``delay_frames`` ago has no
        pose.
        """
        if not self._config.enabled:
            return None
        self.admit(stamp_ns)
        past = list(self._past(stamp_ns).values())
        newest = past[-1] if past else None
        if newest is None or not newest.state.has_pose:
            return None
        stamps_ns, T_cam_target = _unbroken_run(past)
        pose_row = extrapolate(stamps_ns, T_cam_target, stamp_ns)
        return PosePrior(
            newest.stamp_ns,
            pose_row,
            newest.pose_row,
            healthy=newest.state == TrackState.TRACKING,
            supported=newest.gap_frames == 0,
        )

    def _past(self, stamp_ns: int) -> dict[int, Estimate | None]:
        """Frames at least ``delay_frames`` before the given one, oldest first, at most HISTORY_FRAMES."""
        stamps = [stamp for stamp in self._frames if stamp <= stamp_ns]
        end = len(stamps) - self._config.delay_frames
        return {stamp: self._frames[stamp] for stamp in stamps[max(end - HISTORY_FRAMES, 0) : max(end, 0)]}


def _unbroken_run(past: list[Estimate | None]) -> tuple[Int, Float]:
    """The newest estimates that belong to one continuous track, poses all along and no jump between: stamps and poses.

    A reset shows as a jump of the pose, which ``/hat/status`` carries; the count of resets it does not.
    """
    run: list[Estimate] = []
    for estimate in reversed(past):
        if estimate is None or not estimate.state.has_pose:
            break
        run.insert(0, estimate)
    T_cam_target = lie.matrix_from_row(np.stack([estimate.pose_row for estimate in run]))
    R = T_cam_target[:, :3, :3]
    jumps = np.flatnonzero(lie.angle_between(R[1:], R[:-1]) > np.radians(JUMP_DEG))
    start = jumps[-1] + 1 if len(jumps) else 0
    return np.array([estimate.stamp_ns for estimate in run[start:]], dtype=np.int64), T_cam_target[start:]


def extrapolate(stamps_ns: Int, T_cam_target: Float, stamp_ns: int) -> Float:
    """Pose at another time of a target that moves and turns at constant rate, as a (7,) row.

    The line through the poses in the tangent space of the newest is the componentwise Theil-Sen one (median of the
    slopes of all pairs, then median offset; Sen, JASA 63, 1968): up to a quarter of the poses may be wrong.

    Args:
        stamps_ns: (n,) int64 increasing stamps, n >= 1.
        T_cam_target: (n, 4, 4) poses, less than half a turn away from the newest.
        stamp_ns: stamp to extrapolate to.
    """
    newest = T_cam_target[-1]
    if len(T_cam_target) == 1:
        return lie.row_from_matrix(newest)
    seconds = (stamps_ns - stamps_ns[-1]) * 1e-9
    turns = lie.so3_log(T_cam_target[:, :3, :3] @ newest[:3, :3].T)
    tangent = np.concatenate([T_cam_target[:, :3, 3], turns], axis=1)
    first, second = _pairs(len(seconds))
    slopes = (tangent[second] - tangent[first]) / (seconds[second] - seconds[first])[:, None]
    rate = _median(slopes)
    offset = _median(tangent - seconds[:, None] * rate)
    ahead = offset + rate * ((stamp_ns - int(stamps_ns[-1])) * 1e-9)
    return lie.row_from_matrix(lie.transform(lie.so3_exp(ahead[3:]) @ newest[:3, :3], ahead[:3]))


@cache
def _pairs(n: int) -> tuple[Int, ...]:
    """Indices of all pairs of n, the earlier and the later one; n is small and hardly varies."""
    return np.triu_indices(n, k=1)


def _median(values: Float) -> Float:
    """Column medians of (n, m): ``np.median``, without most of its overhead on a few rows."""
    ordered = np.sort(values, axis=0)
    middle = len(ordered) // 2
    return ordered[middle] if len(ordered) % 2 else 0.5 * (ordered[middle - 1] + ordered[middle])
