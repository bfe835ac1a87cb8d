"""A bag on its way into the graph: which image may be sent now, what has come back, when it is over. No middleware."""

from __future__ import annotations

import time
from collections.abc import Generator
from typing import Any

from hat_ros.config import GraphConfig
from hat_ros.core.refusals import Refusals
from hat_ros.io import messages
from hat_ros.io.bag_reader import BagReader, Packet
from hat_ros.ros.timeouts import answer_limit, check_progress

_INPUT_DEPTH = 16


class Playback:
    """Counts and paces the images of a bag.

    Args:
        bag: the recording.
        config: credits and time limits.
        live: send by the recording's clock; otherwise as fast as statuses come back.
        rate: live only: speed relative to the recording.
        first_frame: images skipped at the beginning.
        max_frames: at most so many images, 0 = all.

    Attributes:
        total: images to send.
        sent: images sent so far.
        answered: statuses received.
        dropped: images known to be dropped or refused.
        refusals: those that are known to be refused.
        last_status: the newest status.
        sent_s: stamp -> monotonic time at which the image was sent.
        latency_s: from sending an image to its status, in order of the statuses.
        progress_s: monotonic time of the last progress.
    """

    def __init__(
        self, bag: BagReader, config: GraphConfig, *, live: bool, rate: float, first_frame: int, max_frames: int
    ) -> None:
        self._config, self._live, self._rate = config, live, rate
        self._packets = _chosen(bag, first_frame, max_frames)
        self._next = next(self._packets, None)
        self._window = min(config.credits_replay + 2, _INPUT_DEPTH)
        self._start: tuple[int, float] | None = None
        self.total = max(0, len(bag) - first_frame)
        self.total = min(self.total, max_frames or self.total)
        self.sent = self.answered = self.dropped = 0
        self.refusals = Refusals()
        self.last_status: messages.Status | None = None
        self.sent_s: dict[int, float] = {}
        self.latency_s: list[float] = []
        self.progress_s = time.monotonic()

    @property
    def outstanding(self) -> int:
        """Images sent that are neither answered nor known to be dropped."""
        return self.sent - self.answered - self.dropped

    def take(self) -> Packet | None:
        """The next image if it may be sent now; it is to be sent at once."""
        packet = self._next
        if packet is None or not self._may_send(packet):
            return None
        self._next = next(self._packets, None)
        now = time.monotonic()
        if self.outstanding == 0:
            self.progress_s = now
        self.sent_s[packet.stamp_ns] = now
        self.sent += 1
        return packet

    def _may_send(self, packet: Packet) -> bool:
        if not self._live:
            return self.outstanding < self._window
        if self._start is None:  # real time begins when the first frame, which warms everything up, has been answered
            if self.sent and self.outstanding:
                return False
            if self.sent:
                self._start = (packet.stamp_ns, time.monotonic())
            return True
        since, began = self._start
        return 1e-9 * (packet.stamp_ns - since) <= (time.monotonic() - began) * self._rate

    def note_status(self, status: messages.Status) -> None:
        """A status came back."""
        now = time.monotonic()
        sent_s = self.sent_s.get(status.estimate.stamp_ns)
        if sent_s is not None:
            self.latency_s.append(now - sent_s)
        self.answered += 1
        self.last_status, self.progress_s = status, now
        self.note_dropped(status.dropped_total)

    def note_dropped(self, dropped_total: int) -> None:
        """The entrance reports how many images it has not admitted so far."""
        self.dropped = max(self.dropped, dropped_total)

    def is_done(self) -> bool:
        """Everything sent was answered or dropped; live, where a hanging stage costs frames, the last one was."""
        if self._next is not None:
            return False
        if self.outstanding <= 0 or not self._live:
            return self.outstanding <= 0
        last_ns = max(self.sent_s)
        if self.last_status is not None and self.last_status.estimate.stamp_ns == last_ns:
            return True
        quiet_s = time.monotonic() - max(self.progress_s, self.sent_s[last_ns])
        return quiet_s > self._config.stage_timeout_s

    def check_answers(self) -> None:
        """Notice a graph that does not answer; live, only before the first answer.

        Raises:
            StageTimeoutError: no answer in time.
        """
        if self.outstanding > 0 and not (self._live and self.answered):
            limit_s, option = answer_limit(self._config, first=not self.answered)
            check_progress(self.progress_s, limit_s, f"frame {self.sent - self.outstanding} was not answered", option)

    def summary(self) -> dict[str, Any]:
        """Figures for diagnostics."""
        return {"published": self.sent, "answered": self.answered}

    def close(self) -> None:
        """Close the bag."""
        self._packets.close()


def _chosen(bag: BagReader, first_frame: int, max_frames: int) -> Generator[Packet, None, None]:
    for index, packet in enumerate(bag.packets()):
        if index >= first_frame and (not max_frames or index < first_frame + max_frames):
            yield packet
