"""Time that a stage takes per frame: measured for diagnostics, and added for latency studies."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from contextlib import contextmanager

from hat_ros.io import topics


class ExtraDelay:
    """Random extra time per frame, for latency studies; never touches what is computed.

    Args:
        name: of the stage; seeds the delays.
        longest_ms: largest delay in milliseconds, 0 = none.
    """

    def __init__(self, name: str, longest_ms: float) -> None:
        self._random = random.Random(name)
        self._longest_s = 1e-3 * longest_ms

    def wait(self) -> None:
        """Sleep, if a delay was asked for."""
        if self._longest_s > 0:
            time.sleep(self._longest_s * self._random.random())


class StepTimer:
    """Mean wall time of a stage per frame, reading and writing its messages included; the first frames are left out."""

    WARMUP_FRAMES = 10

    def __init__(self) -> None:
        self._frames = 0
        self._seconds = 0.0

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Around the work on one frame."""
        start = time.perf_counter()
        yield
        self._frames += 1
        if self._frames > self.WARMUP_FRAMES:
            self._seconds += time.perf_counter() - start

    def values(self) -> dict[str, str]:
        """The figure for diagnostics, once there is one."""
        timed = self._frames - self.WARMUP_FRAMES
        return {topics.STEP_MS: f"{1e3 * self._seconds / timed:.4f}"} if timed > 0 else {}
