"""Several frames inside one method at once, without changing what it computes.

Each frame runs the whole ``step`` of the method in a thread of its own. Every stage is wrapped so that it is called by
one frame at a time, in frame order, so each stage sees exactly the calls that it would see from a plain loop; while one
frame is in the motion stage the next can be in the hypotheses. It pays because compiled code, OpenCV and torch
release the interpreter lock.

Two rules make that safe. What a step does before its first stage happens in frame order too, and alone. What it does
after its last stage must not be needed before ``credits`` frames later: for HAT that is the delay of its priors.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar, cast

Stage = TypeVar("Stage")

_START = "start"


class Closed(Exception):
    """An earlier frame failed, or the answer is not waited for any more."""


class StageScheduler:
    """Lets frames through the stages of a method one at a time, in order, and times each stage."""

    def __init__(self) -> None:
        self._next = {_START: 0}
        self._changed = threading.Condition()
        self._closed_from: float = float("inf")
        self._local = threading.local()

    def wrap(self, name: str, stage: Stage) -> Stage:
        """The stage behind its turn: an object whose ``update``, called at most once per step, waits and is timed.

        A :data:`~hat_ros.tracker.StageWrapper`; to be used before the first frame.
        """
        self._next[name] = 0
        return cast("Stage", _ScheduledStage(stage, partial(self._run, name)))

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
        """Let frame ``seq`` and later ones pass no stage any more; earlier ones go on."""
        with self._changed:
            self._closed_from = min(self._closed_from, seq)
            self._changed.notify_all()

    def _run(self, name: str, update: Callable[..., Any], *arguments: Any) -> Any:
        seq, stage_ms = self._local.seq, self._local.stage_ms
        self._wait(name, seq)
        self._leave(_START, seq)
        start = time.perf_counter()
        try:
            return update(*arguments)
        finally:
            stage_ms[name] = 1e3 * (time.perf_counter() - start)
            self._leave(name, seq)

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


class _ScheduledStage:
    """A stage whose ``update`` goes through the scheduler; everything else is the stage's own."""

    def __init__(self, stage: Any, run: Callable[..., Any]) -> None:
        self._stage = stage
        self._run = run

    def update(self, *arguments: Any) -> Any:
        return self._run(self._stage.update, *arguments)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stage, name)
