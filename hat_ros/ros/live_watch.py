"""What a graph has sent, and when it arrived: the figures of a live run."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from hat_ros.array_types import Float


@dataclass(frozen=True)
class Moment:
    """Now, by the two clocks that count: the steady one for durations, the wall clock for stamps."""

    steady_s: float = field(default_factory=time.monotonic)
    wall_ns: int = field(default_factory=time.time_ns)


@dataclass
class Watched:
    """Answers as they arrived.

    Attributes:
        statuses: arrival (monotonic seconds), latency (seconds from the stamp), stamp and state of each status.
        poses: arrival and stamp of each pose.
        reports: arrival, node, level and text of each change in diagnostics.
    """

    statuses: list[tuple[float, float, int, int]] = field(default_factory=list)
    poses: list[tuple[float, int]] = field(default_factory=list)
    reports: list[tuple[float, str, int, str]] = field(default_factory=list)

    def first_pose_since(self, moment: Moment) -> float | None:
        """Seconds from a moment to the arrival of the first pose of an image taken after it; None while there is none.

        The camera must stamp by the wall clock.
        """
        return next((arrived - moment.steady_s for arrived, stamp in self.poses if stamp > moment.wall_ns), None)

    def longest_gap(self, from_s: float, to_s: float) -> float:
        """Longest time without a pose between two moments, seconds; the whole time when there was none."""
        inside = [arrived for arrived, _ in self.poses if from_s < arrived < to_s]
        return float(np.diff([from_s, *inside, to_s]).max())

    def n_poses(self, from_s: float, to_s: float) -> int:
        """Poses that arrived between two moments."""
        return sum(from_s < arrived <= to_s for arrived, _ in self.poses)

    def latency_ms(self, from_s: float, to_s: float) -> Float:
        """(n,) latencies of the statuses between two moments, milliseconds."""
        return 1e3 * np.array([latency for arrived, latency, *_ in self.statuses if from_s < arrived <= to_s])

    def n_out_of_order(self) -> int:
        """Poses whose stamp is not later than that of the pose before."""
        stamps = np.array([stamp for _, stamp in self.poses], dtype=np.int64)
        return int(np.sum(np.diff(stamps) <= 0))
