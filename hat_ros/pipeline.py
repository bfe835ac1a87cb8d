"""A method run over a recording in this process: admission, timing, progress. No ROS.

The stages are the ones that the graph's nodes own, and frames are admitted by the same rule, so both give the same
bytes. Clocks are read here, never inside a stage.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.datasets import Recording
from hat_ros.datasets.sequence import load_sequence
from hat_ros.errors import UsageError
from hat_ros.evaluation.metrics import mask_iou
from hat_ros.methods import Method
from hat_ros.target import Target, load_target
from hat_ros.tracker import Step
from hat_ros.types import Estimate, Frame

STAGE_NAMES = ("segmentation", "hypotheses", "motion", "selector", "fusion")
MEASURED = ("latency_ms", "decode_ms", *(f"{name}_ms" for name in STAGE_NAMES), "mask_iou")
# First frames left out of throughput and latency: compiled code is loaded and caches are filled there.
WARMUP_FRAMES = 10


@dataclass(frozen=True)
class Processed:
    """One admitted frame and what came of it.

    Attributes:
        frame: the frame as recorded, given mask included.
        step: what the stages said.
        latency_ms: wall time of the step.
        decode_ms: wall time of reading and decoding the frame before it.
        stage_ms: wall time by stage.
        mask_iou: overlap of the detected and the recorded silhouette, NaN when none was recorded.
    """

    frame: Frame
    step: Step
    latency_ms: float
    decode_ms: float
    stage_ms: dict[str, float]
    mask_iou: float

    def measured(self) -> tuple[float, ...]:
        """The values of :data:`MEASURED`, in order."""
        return (self.latency_ms, self.decode_ms, *self.stage_ms.values(), self.mask_iou)


class Admission:
    """The entrance rule of DESIGN 5.1: stamps are positive and strictly increase; what is rejected is counted."""

    def __init__(self) -> None:
        self.last_stamp_ns = 0
        self.rejected = 0

    def admits(self, stamp_ns: int) -> bool:
        """Whether a frame with this stamp enters; remembers it if so."""
        if stamp_ns <= self.last_stamp_ns:
            self.rejected += 1
            return False
        self.last_stamp_ns = stamp_ns
        return True


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
        self.admission = Admission()

    def run(self, frames: Iterable[Frame]) -> Iterator[Processed]:
        """Process frames in order; rejected ones are counted in ``admission``."""
        iterator = iter(frames)
        while True:
            start = time.perf_counter()
            frame = next(iterator, None)
            if frame is None:
                return
            if self.admission.admits(frame.stamp_ns):
                yield self._process(frame, 1e3 * (time.perf_counter() - start))

    def finish(self) -> list[Estimate]:
        """Estimates of a method that answers only after the last frame; empty for causal ones."""
        return self._method.finish()

    def _process(self, frame: Frame, decode_ms: float) -> Processed:
        seen = frame if self._masks_given else replace(frame, given_mask=None)
        start = time.perf_counter()
        step = self._method.step(seen)
        latency_ms = 1e3 * (time.perf_counter() - start)
        iou = float("nan")
        if frame.given_mask is not None and (silhouette := frame.given_mask == 255).any():
            iou = mask_iou(None if step.detection is None else step.detection.mask, silhouette)
        return Processed(frame, step, latency_ms, decode_ms, self._clock.take(), iou)


@dataclass(frozen=True)
class Source:
    """A recording that was opened, with its target."""

    path: Path
    recording: Recording
    target: Target

    def frames(self, start: int = 0, limit: int | None = None) -> Iterator[Frame]:
        """Frames from number ``start`` on, at most ``limit`` of them."""
        stop = None if limit is None else start + limit
        return islice(self.recording.frames(stop), start, None)

    def count(self, start: int = 0, limit: int | None = None) -> int:
        """How many frames :meth:`frames` brings."""
        rest = max(0, len(self.recording) - start)
        return rest if limit is None else min(rest, limit)


def open_source(path: str | Path) -> Source:
    """Open a bag or a folder of the ``sequence`` layout, and the CAD model beside it.

    Raises:
        UsageError: there is nothing of that name.
        InputError: it is neither, or is malformed.
    """
    path = Path(path)
    if not path.exists():
        raise UsageError(f"recording {path}: no such file or folder")
    if (path / "labels.json").is_file():
        recording = load_sequence(path)
        return Source(path, recording, load_target(recording.target_path, recording.unit_scale))
    raise UsageError(f"recording {path}: neither a bag (metadata.yaml) nor a sequence folder (labels.json)")


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
        "decode_ms_mean": float(column["decode_ms"].mean()),
        **{f"{name}_ms_mean": float(column[f"{name}_ms"].mean()) for name in STAGE_NAMES},
    }
