"""When the absolute estimator is asked: anchor opportunities at a spacing of input frames (paper, Stage 2)."""

from __future__ import annotations

from hat_ros.config import KeyframeConfig

# Attempts in a row that must have met a healthy track before it counts as settled: as many as the decoder warms up for.
SETTLING_ATTEMPTS = 3


class KeyframeSchedule:
    """Opens an anchor opportunity every ``gap_frames`` input frames, the first frame included.

    An attempt counts even when every candidate is rejected later. Without a detection there is no attempt: the
    opportunity stays open for the next frame that has one.

    Our extension: while a track is settled, an absolute estimate has little to add, and the gap is
    ``settled_factor`` times as long; and a failed attempt is repeated as many times sooner, since a wrong start
    stands until then: a first one that decided nothing, or any on a detection that soon turned out to be of something
    else. Frames that were left out count as well. The paper's spacing is a factor of 1.
    """

    def __init__(self, config: KeyframeConfig) -> None:
        self._gap_frames = config.gap_frames
        self._early_gap_frames = max(1, config.gap_frames // config.settled_factor)
        self._counts_missed = config.settled_factor > 1
        self._settled_gap_frames = config.gap_frames * config.settled_factor
        self.reset()

    def reset(self) -> None:
        """The next frame with a detection is an opportunity."""
        self._frames_since_attempt = self._gap_frames
        self._n_attempts = 0
        self._decided = True
        self._healthy_attempts = 0

    def update(self, has_detection: bool, healthy: bool = False, failed: bool = False, n_missed: int = 0) -> bool:
        """Count one input frame; True when candidates are to be generated for it.

        Args:
            has_detection: the target has been found in the image.
            healthy: the fused state of the past, as the prior of this frame tells it, is TRACKING.
            failed: what the last attempt was made on turned out to be a part of the target, or something else.
            n_missed: frames left out right before this one; after a whole gap of them no track is settled.
        """
        n_missed = n_missed if self._counts_missed else 0
        self._frames_since_attempt += 1 + n_missed
        if not healthy or n_missed >= self._gap_frames:
            self._healthy_attempts = 0
        settled = self._healthy_attempts >= SETTLING_ATTEMPTS
        gap_frames = self._settled_gap_frames if settled else self._gap_frames
        if failed or (self._n_attempts == 1 and not self._decided):
            gap_frames = self._early_gap_frames
        if not has_detection or self._frames_since_attempt < gap_frames:
            return False
        self._frames_since_attempt = 0
        self._n_attempts += 1
        self._healthy_attempts += healthy
        return True

    def answered(self, decided: bool) -> None:
        """What came of the last attempt: whether one basin clearly leads."""
        self._decided = decided
