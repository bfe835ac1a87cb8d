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
        config: its time limits and credits.
        live: a frame that is late is given up soon, and the next one enters.
        restarts: stamps that step back begin anew, see :class:`~hat_ros.core.sync.Admission`.

    Attributes:
        admission: stamps and credits.
        given_up: frames that were given up so far.
    """

    def __init__(self, config: GraphConfig, live: bool, restarts: bool = False) -> None:
        self._config, self._live = config, live
        self._entered_s: dict[int, float] = {}
        self._is_warm = False
        self._in_a_row = 0
        self.admission = Admission(config.credits_live if live else config.credits_replay, restarts)
        self.given_up = 0

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
        self._is_warm, self._in_a_row = True, 0
        return True

    def give_up(self) -> int:
        """Give up all frames under way; how many there were."""
        lost = len(self.admission.give_up())
        self._entered_s.clear()
        self.given_up += lost
        return lost

    def overdue(self) -> StageTimeoutError | None:
        """What is wrong when the oldest frame has waited too long; then all frames under way are given up."""
        oldest = next(iter(self._entered_s), None)
        limit_s, option = answer_limit(self._config, not self._is_warm, self._in_a_row if self._live else None)
        if oldest is None or time.monotonic() - self._entered_s[oldest] <= limit_s:
            return None
        self.give_up()
        self._in_a_row += 1
        late = f"no status for frame {oldest} within {limit_s:g} s (raise {option} if it is only slow)"
        return StageTimeoutError(f"{late}: {HANGS}")
