"""How many frames should have come between two that did: a recording or a link may leave some out."""

from __future__ import annotations

from collections import deque

import numpy as np

# Periods whose median is the usual one.
_N_PERIODS = 9


class Cadence:
    """Learns the usual period between frames from their stamps."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget earlier frames."""
        self._last_ns: int | None = None
        self._periods_ns: deque[int] = deque(maxlen=_N_PERIODS)

    def missed(self, stamp_ns: int) -> int:
        """Frames left out right before this one, 0 while there is nothing to compare with; once per frame."""
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if last_ns is None:
            return 0
        period_ns = stamp_ns - last_ns
        usual_ns = float(np.median(self._periods_ns)) if self._periods_ns else period_ns
        self._periods_ns.append(period_ns)
        return max(0, round(period_ns / usual_ns) - 1) if usual_ns > 0 else 0
