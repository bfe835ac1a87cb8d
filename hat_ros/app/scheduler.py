"""Several frames inside one method at once, without changing what it computes.

Each frame runs the whole ``step`` of the method in a thread of its own. A turnstile before every stage lets frames
through one at a time, in frame order, so each stage sees exactly the calls that it would see from a plain loop; while
one frame is in the motion stage the next can be in the hypotheses. It pays because compiled code, OpenCV and torch
release the interpreter lock.

Two rules make that safe. What a step does before its first stage happens in frame order too, and alone. What it does
after its last stage must not be needed before ``credits`` frames later: for HAT that is the delay of its priors.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_START = "start"


class Closed(Exception):
    """An earlier frame failed, or nobody waits for the answer any more."""


class Turnstiles:
    """One turnstile per stage.

    Args:
        stages: stage name -> object with an ``update`` that a step calls at most once; it is replaced by one that
            passes the turnstile and is timed.
    """

    def __init__(self, stages: dict[str, Any]) -> None:
        self._next = dict.fromkeys((_START, *stages), 0)
        self._changed = threading.Condition()
        self._closed_from: float = float("inf")
        self._local = threading.local()
        for name, stage in stages.items():
            stage.update = self._guarded(name, stage.update)

    @contextmanager
    def frame(self, seq: int) -> Iterator[dict[str, float]]:
        """Within, the calling thread runs the step of frame ``seq``; frames are numbered from 0 without a gap.

        Yields:
            Milliseconds that the step spent inside each stage so far, waiting left out.

        Raises:
            Closed: :meth:`close` was called, or the step of an earlier frame failed.
        """
        stage_ms: dict[str, float] = {}
        self._local.seq, self._local.stage_ms = seq, stage_ms
        self._wait(_START, seq)
        try:
            yield stage_ms
        except BaseException:
            self.close(seq)
            raise
        for name in self._next:  # stages that this step had no use for
            self._wait(name, seq)
            self._leave(name, seq)

    def close(self, seq: int) -> None:
        """Let frame ``seq`` and later ones pass no turnstile any more; earlier ones go on."""
        with self._changed:
            self._closed_from = min(self._closed_from, seq)
            self._changed.notify_all()

    def _guarded(self, name: str, update: Callable[..., Any]) -> Callable[..., Any]:
        def guarded(*args: Any) -> Any:
            seq, stage_ms = self._local.seq, self._local.stage_ms
            self._wait(name, seq)
            self._leave(_START, seq)
            start = time.perf_counter()
            try:
                return update(*args)
            finally:
                stage_ms[name] = 1e3 * (time.perf_counter() - start)
                self._leave(name, seq)

        return guarded

    def _wait(self, name: str, seq: int) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._next[name] >= seq or self._closed_from <= seq)
            if self._closed_from <= seq:
                raise Closed

    def _leave(self, name: str, seq: int) -> None:
        with self._changed:
            if self._next[name] == seq:
                self._next[name] = seq + 1
                self._changed.notify_all()
