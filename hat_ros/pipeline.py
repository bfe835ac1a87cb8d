"""A method run over a recording in this process: admission, timing, progress. No ROS.

The stages are the ones that the graph's nodes own, and frames are admitted by the same rule, so both give the same
bytes. Clocks are read here, never inside a stage.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.core.sync import Admission
from hat_ros.errors import FrameError
from hat_ros.evaluation.metrics import mask_iou
from hat_ros.methods import Method
from hat_ros.tracker import Step
from hat_ros.types import Frame

STAGE_NAMES = ("segmentation", "hypotheses", "motion", "selector", "fusion")
MEASURED = ("latency_ms", "cpu_ms", "decode_ms", *(f"{name}_ms" for name in STAGE_NAMES), "rss_mib", "mask_iou")
# First frames left out of throughput and latency: compiled code is loaded and caches are filled there.
WARMUP_FRAMES = 10


@dataclass(frozen=True)
class Processed:
    """One admitted frame and what came of it.

    Attributes:
        frame: the frame as recorded, given mask included.
        step: what the stages said.
        latency_ms: wall time of the step.
        cpu_ms: processor time of the step, all threads together.
        decode_ms: wall time of reading and decoding the frame before it.
        stage_ms: wall time by stage.
        rss_mib: resident memory of this process after the step.
        mask_iou: overlap of the detected and the recorded silhouette, NaN when none was recorded.
    """

    frame: Frame
    step: Step
    latency_ms: float
    cpu_ms: float
    decode_ms: float
    stage_ms: dict[str, float]
    rss_mib: float
    mask_iou: float

    def measured(self) -> tuple[float, ...]:
        """The values of :data:`MEASURED`, in order."""
        return (self.latency_ms, self.cpu_ms, self.decode_ms, *self.stage_ms.values(), self.rss_mib, self.mask_iou)


class StageClock:
    """Measures each stage of a method from outside, by wrapping the stage objects' ``update``."""

    def __init__(self, method: Method) -> None:
        self._stage_ms = dict.fromkeys(STAGE_NAMES, 0.0)
        for name, stage in method.stages.items():
            stage.update = self._timed(name, stage.update)

    def _timed(self, name: str, update: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any) -> Any:
            start = time.perf_counter()
            try:
                return update(*args)
            finally:
                self._stage_ms[name] += 1e3 * (time.perf_counter() - start)

        return timed

    def take(self) -> dict[str, float]:
        """Milliseconds since the last call, by stage."""
        taken, self._stage_ms = self._stage_ms, dict.fromkeys(STAGE_NAMES, 0.0)
        return taken


class Pipeline:
    """Feeds frames to a method, one at a time.

    Args:
        method: what estimates the poses.
        masks_given: hand the recorded masks to the method; otherwise they only serve to judge its own.
    """

    def __init__(self, method: Method, masks_given: bool) -> None:
        self._method = method
        self._masks_given = masks_given
        self._clock = StageClock(method)
        self._admission = Admission(credits=1)
        self.rejected = 0

    @property
    def causal(self) -> bool:
        """Whether every step is final."""
        return self._method.causal

    def run(self, frames: Iterable[Frame | FrameError]) -> Iterator[Processed]:
        """Process frames in order; those with a late stamp or malformed are counted in ``rejected``."""
        iterator = iter(frames)
        while True:
            start = time.perf_counter()
            frame = next(iterator, None)
            if frame is None:
                return
            try:
                if isinstance(frame, FrameError):
                    raise frame
                self._admission.admit(frame.stamp_ns)
            except FrameError:
                self.rejected += 1
                continue
            yield self._process(frame, 1e3 * (time.perf_counter() - start))
            self._admission.answered(frame.stamp_ns)

    def finish(self, steps: list[Step]) -> list[Step]:
        """The collected steps with the answers of a method that gives them only after the last frame."""
        return [replace(step, estimate=final) for step, final in zip(steps, self._method.finish(), strict=True)]

    def _process(self, frame: Frame, decode_ms: float) -> Processed:
        seen = frame if self._masks_given else replace(frame, given_mask=None)
        start, start_cpu = time.perf_counter(), time.process_time()
        step = self._method.step(seen)
        latency_ms, cpu_ms = 1e3 * (time.perf_counter() - start), 1e3 * (time.process_time() - start_cpu)
        stage_ms, iou = self._clock.take(), float("nan")
        looked = step.detection is not None or stage_ms["segmentation"] > 0
        if looked and frame.given_mask is not None and (silhouette := frame.given_mask == 255).any():
            iou = mask_iou(None if step.detection is None else step.detection.mask, silhouette)
        return Processed(frame, step, latency_ms, cpu_ms, decode_ms, stage_ms, resident_mib(), iou)


def resident_mib() -> float:
    """Resident memory of this process in MiB; NaN where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return float("nan")
    return pages * resource.getpagesize() / 2**20


def memory_summary(rows: list[tuple[float, ...]]) -> dict[str, float]:
    """How much resident memory grew from the first to the last quarter of a run: medians over rows of MEASURED."""
    rss_mib = np.array([row[MEASURED.index("rss_mib")] for row in rows])
    quarter = len(rss_mib) // 4
    if quarter == 0:
        return {"memory_growth_mib": float("nan")}
    # The first quarter begins after warm-up: caches fill there by design.
    first = rss_mib[min(WARMUP_FRAMES, quarter) :][:quarter]
    return {"memory_growth_mib": float(np.median(rss_mib[-quarter:]) - np.median(first))}


def latency_summary(rows: list[tuple[float, ...]]) -> dict[str, float]:
    """Throughput, latency percentiles and mean time per stage over rows of :data:`MEASURED`, after warm-up.

    Throughput counts decoding and the method, not the writing of results.
    """
    table = np.array(rows[WARMUP_FRAMES:] or rows, dtype=np.float64).reshape(-1, len(MEASURED))
    if not len(table):
        return {"fps": float("nan"), "latency_ms_p50": float("nan"), "latency_ms_p99": float("nan")}
    column = dict(zip(MEASURED, table.T, strict=True))
    busy_ms = column["latency_ms"] + column["decode_ms"]
    return {
        "fps": float(1e3 * len(table) / busy_ms.sum()),
        "latency_ms_p50": float(np.percentile(column["latency_ms"], 50)),
        "latency_ms_p99": float(np.percentile(column["latency_ms"], 99)),
        "latency_ms_max": float(column["latency_ms"].max()),
        "cpu_ms_mean": float(column["cpu_ms"].mean()),
        "decode_ms_mean": float(column["decode_ms"].mean()),
        **{f"{name}_ms_mean": float(column[f"{name}_ms"].mean()) for name in STAGE_NAMES},
    }
