"""A method run over a recording in this process: admission, frames in flight, timing. No ROS.

The stages are the ones that the graph's nodes own, and frames are admitted by the same rule, so both give the same
bytes. Clocks are read here, never inside a stage.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Protocol

from hat_ros.app.scheduler import StageScheduler
from hat_ros.app.timing import STAGE_NAMES, LapClock, resident_mib
from hat_ros.core.refusals import Refusals
from hat_ros.core.sync import Admission
from hat_ros.errors import FrameError
from hat_ros.tracker import StageWrapper, Step
from hat_ros.types import Estimate, Frame


@dataclass(frozen=True)
class Processed:
    """One admitted frame and its answers.

    Attributes:
        step: the answers of the stages.
        latency_ms: wall time from admission to the answer, waiting behind frames in flight included.
        decode_ms: wall time of reading and decoding the frame before that, beside earlier frames.
        stage_ms: wall time by stage, waiting left out.
        rss_mib: resident memory of this process after the step.
        period_ms: wall time from the previous answer, or the start, to this one.
        cpu_ms: processor time of the whole process in that period.
    """

    step: Step
    latency_ms: float
    decode_ms: float
    stage_ms: dict[str, float]
    rss_mib: float
    period_ms: float = float("nan")
    cpu_ms: float = float("nan")

    def measured(self) -> tuple[float, ...]:
        """The values of :data:`~hat_ros.app.timing.MEASURED`, in order."""
        return (
            self.latency_ms,
            self.period_ms,
            self.cpu_ms,
            self.decode_ms,
            *self.stage_ms.values(),
            self.rss_mib,
        )


class Method(Protocol):
    """What turns frames into poses."""

    causal: bool
    """Whether ``step`` gives the final answer; if not, :meth:`finish` does."""

    concurrent: bool
    """Whether steps of several frames may overlap by the rules of :mod:`hat_ros.app.scheduler`."""

    def step(self, frame: Frame) -> Step:
        """Process one frame, stamps strictly increasing."""
        ...

    def finish(self) -> list[Estimate]:
        """The estimates of all frames, for a method that is not causal; empty otherwise."""
        ...


class Pipeline:
    """Feeds the frames of one run to a method.

    Args:
        create: builds what estimates the poses, given the wrapper for its stages.
        credits: W, frames in flight at once, each in a thread; the answers do not depend on it.
    """

    def __init__(self, create: Callable[[StageWrapper], Method], credits: int = 1) -> None:
        self._scheduler = StageScheduler()
        self._method = create(self._scheduler.wrap)
        self._credits = credits if self._method.concurrent else 1
        self._admission = Admission(self._credits)
        self.refusals = Refusals()

    @property
    def credits(self) -> int:
        """Frames in flight at once."""
        return self._credits

    @property
    def causal(self) -> bool:
        """Whether every step is final."""
        return self._method.causal

    def run(self, frames: Iterable[Frame | FrameError]) -> Iterator[Processed]:
        """Process frames, answers in order; those with a late stamp or malformed are counted in ``refusals``.

        An error of the recording is raised after the answers to what was read before it.
        """
        in_flight: deque[Future[Processed]] = deque()
        clock = LapClock()
        with closing(_ReadAhead(frames)) as attempts, ThreadPoolExecutor(self._credits, "frame") as threads:
            try:
                admitted = self._admitted(attempts)
                failure: Exception | None = None

                def fill() -> None:
                    nonlocal failure
                    try:
                        while self._admission.has_credit and (entry := next(admitted, None)) is not None:
                            in_flight.append(threads.submit(self._process, *entry))
                    except Exception as error:  # of reading: what was read before comes first
                        failure = error

                fill()
                while in_flight:
                    done = in_flight.popleft().result()
                    self._admission.answered(done.step.estimate.stamp_ns)
                    period_ms, cpu_ms = clock.lap()
                    answer = replace(done, period_ms=period_ms, cpu_ms=cpu_ms)
                    fill()  # now: what the caller does with the answer takes its time
                    yield answer
                if failure is not None:
                    raise failure
            finally:
                self._scheduler.close(0)

    def finish(self, steps: list[Step]) -> list[Step]:
        """The collected steps with the answers of a method that gives them only after the last frame."""
        return [replace(step, estimate=final) for step, final in zip(steps, self._method.finish(), strict=True)]

    def _admitted(self, attempts: _ReadAhead) -> Iterator[tuple[int, Frame, float]]:
        """Sequence number, frame and decoding time of the frames that may enter; asked only when there is credit."""
        for frame, decode_ms in attempts:
            if isinstance(frame, FrameError):
                self.refusals.add(str(frame))
                continue
            try:
                seq = self._admission.admit(frame.stamp_ns)
            except FrameError as error:
                self.refusals.add(f"frame {frame.stamp_ns}: {error}")
                continue
            yield seq, frame, decode_ms

    def _process(self, seq: int, frame: Frame, decode_ms: float) -> Processed:
        start = time.perf_counter()
        with self._scheduler.frame(seq) as stage_ms:
            step = self._method.step(frame)
        latency_ms = 1e3 * (time.perf_counter() - start)
        stage_ms = {name: stage_ms.get(name, 0.0) for name in STAGE_NAMES}
        return Processed(step, latency_ms, decode_ms, stage_ms, resident_mib())


class _ReadAhead:
    """Reads and decodes the next frame in a thread while earlier ones are processed: each with its decoding time, ms.

    A recording is read by one thread from beginning to end, as SQLite demands.
    """

    def __init__(self, frames: Iterable[Frame | FrameError]) -> None:
        self._frames = iter(frames)
        self._thread = ThreadPoolExecutor(1, "read")
        self._next = self._thread.submit(self._read)

    def __iter__(self) -> Iterator[tuple[Frame | FrameError, float]]:
        while True:
            frame, decode_ms = self._next.result()
            if frame is None:
                return
            self._next = self._thread.submit(self._read)
            yield frame, decode_ms

    def close(self) -> None:
        """End the reading."""
        if isinstance(self._frames, Generator):
            self._thread.submit(self._frames.close)
        self._thread.shutdown()

    def _read(self) -> tuple[Frame | FrameError | None, float]:
        start = time.perf_counter()
        frame = next(self._frames, None)
        return frame, 1e3 * (time.perf_counter() - start)
