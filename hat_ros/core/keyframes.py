"""When the absolute estimator is asked: anchor opportunities at a fixed spacing of input frames (paper, Stage 2)."""

from __future__ import annotations

from hat_ros.config import KeyframeConfig


class KeyframeSchedule:
    """Opens an anchor opportunity every ``gap_frames`` input frames, the first frame included.

    An attempt counts even when every candidate is rejected later. Without a detection there is no attempt: the
    opportunity stays open for the next frame that has one.
    """

    def __init__(self, config: KeyframeConfig) -> None:
        self._gap_frames = config.gap_frames
        self.reset()

    def update(self, has_detection: bool) -> bool:
        """Count one input frame; True when candidates are to be generated for it."""
        self._frames_since_attempt += 1
        if not has_detection or self._frames_since_attempt < self._gap_frames:
            return False
        self._frames_since_attempt = 0
        return True

    def reset(self) -> None:
        """The next frame with a detection is an opportunity."""
        self._frames_since_attempt = self._gap_frames
