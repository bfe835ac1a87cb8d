"""Is the camera there, and does the graph keep up with it? Judged once a second from arrivals and drops alone."""

from __future__ import annotations

import time

from hat_ros.ros.diagnostics import STALE, WARN

# Shorter silences are jitter; a slow camera may miss two images.
SILENT_S = 1.0
MISSED_IMAGES = 3
# From here on other tools call a source stale, too: diagnostic_aggregator's limit.
STALE_S = 5.0
# Drops are judged over so long: a keyframe that holds up some frames is no overload.
OVERLOAD_PERIOD_S = 10.0
OVERLOAD_SHARE = 0.1


class CameraWatch:
    """Notes each image that arrives.

    Attributes:
        is_silent: the last judgement of :meth:`silence`.
        is_overloaded: that of :meth:`overload`.
    """

    def __init__(self) -> None:
        self._last_s: float | None = None
        self._interval_s = 0.0
        self._arrived = 0
        self._since = (time.monotonic(), 0, 0)
        self.is_silent = self.is_overloaded = False

    def note_image(self) -> None:
        """An image arrived."""
        now = time.monotonic()
        if self._last_s is not None:
            self._interval_s = now - self._last_s
        self._last_s = now
        self._arrived += 1

    @property
    def age_s(self) -> float:
        """Seconds since the last image, NaN before the first."""
        return float("nan") if self._last_s is None else time.monotonic() - self._last_s

    def silence(self) -> tuple[int, str] | None:
        """Level and text while no image comes that should; None while images come, and before the first."""
        age_s = self.age_s
        self.is_silent = age_s > max(SILENT_S, MISSED_IMAGES * self._interval_s)
        return (STALE if age_s > STALE_S else WARN, f"no image for {age_s:.1f} s") if self.is_silent else None

    def overload(self, dropped_total: int) -> str | None:
        """Asked once a second: a sentence when the graph begins or ceases to lose more images than it should."""
        since_s, arrived, dropped = self._since
        passed_s = time.monotonic() - since_s
        if passed_s < OVERLOAD_PERIOD_S:
            return None
        lost, all_images = dropped_total - dropped, self._arrived - arrived
        self._since = (time.monotonic(), self._arrived, dropped_total)
        before, self.is_overloaded = self.is_overloaded, lost > OVERLOAD_SHARE * max(all_images, 1)
        if self.is_overloaded == before:
            return None
        return f"{lost} of the last {max(all_images, lost)} images were dropped, in {passed_s:.0f} s" + (
            ": the camera is faster than this machine" if self.is_overloaded else ": the graph keeps up again"
        )
