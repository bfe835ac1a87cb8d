"""Frames under way in the graph: their credits, and how long each has been waiting for its status."""

from __future__ import annotations

import time

from hat_ros.config import GraphConfig
from hat_ros.core.sync import Admission
from hat_ros.errors import StageTimeoutError
from hat_ros.ros.timeouts import HANGS, answer_limit


class FramesInFlight:
    """Admits frames by credit and notices one that is not answered in time.

    Args:
        config: its time limits and, in a replay, the credits W.
        live: one frame in flight.
        restarts: stamps that step back begin anew, see :class:`~hat_ros.core.sync.Admission`.

    Attributes:
        admission: stamps and credits.
    """

    def __init__(self, config: GraphConfig, live: bool, restarts: bool = False) -> None:
        self._config = config
        self._entered_s: dict[int, float] = {}
        self._is_warm = False
        self.admission = Admission(1 if live else config.credits_replay, restarts)

    @property
    def admitted(self) -> int:
        """Frames admitted since the start."""
        return self.admission.seq + 1

    def enter(self, stamp_ns: int) -> int:
        """Let a frame in; its number."""
        seq = self.admission.admit(stamp_ns)
        self._entered_s[stamp_ns] = time.monotonic()
        return seq

    def leave(self, stamp_ns: int) -> bool:
        """Return the credit of a frame that has its status; False for one that was not under way."""
        if not self.admission.answered(stamp_ns):
            return False
        del self._entered_s[stamp_ns]
        self._is_warm = True
        return True

    def overdue(self) -> StageTimeoutError | None:
        """What is wrong when the oldest frame has waited too long; then all frames under way are given up."""
        oldest = next(iter(self._entered_s), None)
        limit_s, option = answer_limit(self._config, first=not self._is_warm)
        if oldest is None or time.monotonic() - self._entered_s[oldest] <= limit_s:
            return None
        self.admission.give_up()
        self._entered_s.clear()
        late = f"no status for frame {oldest} within {limit_s:g} s (raise {option} if it is only slow)"
        return StageTimeoutError(f"{late}: {HANGS}")
