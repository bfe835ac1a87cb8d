"""``hat profile``: network passes, renders and time per keyframe.

On an accelerator every measured call waits for the device before and after, so that the time belongs to the part it
stands beside. Stages run one after another here; ``hat track`` and the graph let them overlap, so their throughput is
higher.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

from hat_ros.bench.evaluation.tables import Column, Table
from hat_ros.bench.experiments.meter import CONSTRUCTION, Meter, Tally
from hat_ros.bench.runs.folder import Watcher
from hat_ros.bench.runs.track import GIVEN_MASK_BACKENDS
from hat_ros.bench.source import Source
from hat_ros.config import HatConfig
from hat_ros.errors import MissingDependencyError, UsageError
from hat_ros.spans import listening
from hat_ros.tracker import HatTracker
from hat_ros.types import Frame

# Backends that run networks.
LEARNED = frozenset({"mask2former", "megapose", "picopose", "gigapose", "droid"})


@dataclass(frozen=True)
class Profile:
    """What a run cost.

    Attributes:
        rows: stages and their parts: name, and name indented for tables.
        device: what the networks ran on.
        start: tallies from construction to the end of the first keyframe: weights, templates, first compilations.
        start_s: wall time of that.
        keyframe: mean tallies of the later keyframes, empty when there was none.
        between: mean tallies of the later frames that were none, empty when there was none.
        n_keyframes: later keyframes.
        n_between: later frames between them.
        fps: later frames per second, decoding included.
        device_memory_mib: peak memory allocated on the device, NaN without one.
        host_memory_mib: peak resident memory of the process.
    """

    rows: Sequence[tuple[str, str]]
    device: str
    start: Mapping[str, Tally]
    start_s: float
    keyframe: Mapping[str, Tally]
    between: Mapping[str, Tally]
    n_keyframes: int
    n_between: int
    fps: float
    device_memory_mib: float
    host_memory_mib: float

    def table(self) -> Table:
        """One row per stage and part: calls, images and milliseconds per keyframe and per frame between."""
        rows = []
        for name, shown in self.rows:
            start = self.start.get(name, Tally())
            row: dict[str, Any] = {"part": shown, "start_images": start.images, "start_s": start.seconds}
            for label, tallies in (("key", self.keyframe), ("other", self.between)):
                if tallies:
                    tally = tallies.get(name, Tally())
                    row |= {f"{label}_calls": tally.calls, f"{label}_images": tally.images}
                    row[f"{label}_ms"] = 1e3 * tally.seconds
            rows.append(row)
        columns = (
            Column("part", "part"),
            Column("key_calls", "calls/keyframe", ".1f"),
            Column("key_images", "images/keyframe", ".1f"),
            Column("key_ms", "ms/keyframe", ".1f"),
            Column("other_calls", "calls between", ".1f"),
            Column("other_images", "images between", ".1f"),
            Column("other_ms", "ms between", ".1f"),
            Column("start_images", "images at start", ".0f"),
            Column("start_s", "s at start", ".1f"),
        )
        return Table(f"On {self.device}: {self.n_keyframes} keyframes, {self.n_between} frames between", columns, rows)

    def summary(self) -> dict[str, Any]:
        """The figures beside the table."""
        return {
            "device": self.device,
            "start_s": self.start_s,
            "keyframes": self.n_keyframes,
            "frames_between": self.n_between,
            "fps": self.fps,
            "device_memory_mib": self.device_memory_mib,
            "host_memory_mib": self.host_memory_mib,
        }


def profile(source: Source, config: HatConfig, limit: int | None = None, watch: Watcher | None = None) -> Profile:
    """Run HAT over a recording with stages and parts measured.

    Args:
        source: the recording.
        config: configuration of all stages.
        limit: at most this many frames.
        watch: called with frames done, frames in all and the newest state.

    Raises:
        UsageError: no frame was a keyframe, so there is nothing to say.
        MissingDependencyError: a backend's package is not installed.
        InputError: bad input, as in a run.
    """
    wait, device, peak_mib = _device(config)
    meter = Meter(wait)
    done = _frames(source, config, limit, meter, watch)
    first = next((index for index, frame in enumerate(done) if frame.keyframe), None)
    if first is None:
        raise UsageError(f"{source.path}: none of {len(done)} frames was a keyframe, so there is nothing to measure")
    opening, later = done[: first + 1], done[first + 1 :]
    keyframes, between = ([frame for frame in later if frame.keyframe is kind] for kind in (True, False))
    busy_s = sum(frame.seconds for frame in later)
    return Profile(
        rows=meter.rows(),
        device=device,
        start=_summed(opening),
        start_s=sum(frame.seconds for frame in opening),
        keyframe=_summed(keyframes, len(keyframes)),
        between=_summed(between, len(between)),
        n_keyframes=len(keyframes),
        n_between=len(between),
        fps=len(later) / busy_s if later else float("nan"),
        device_memory_mib=peak_mib(),
        host_memory_mib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    )


@dataclass(frozen=True)
class _Metered:
    """One frame: whether it was a keyframe, the time since the one before (decoding included), tallies by part."""

    keyframe: bool
    seconds: float
    tallies: dict[str, Tally]


def _frames(
    source: Source, config: HatConfig, limit: int | None, meter: Meter, watch: Watcher | None
) -> list[_Metered]:
    """Run HAT; the first frame takes the time of construction."""
    given = config.segmentation.backend in GIVEN_MASK_BACKENDS
    total = source.count(0, limit)
    done: list[_Metered] = []
    mark = time.perf_counter()
    with ExitStack() as measured:
        measured.enter_context(listening(meter.part))
        if _is_learned(config):
            measured.enter_context(meter.networks())
        with meter.stage(CONSTRUCTION):
            tracker = HatTracker(config, source.target, meter.wrap)
        for frame in source.frames(0, limit, given):
            if not isinstance(frame, Frame):
                continue
            step = tracker.step(frame)
            before, mark = mark, time.perf_counter()
            done.append(_Metered(len(step.candidates) > 0, mark - before, meter.take()))
            if watch is not None:
                watch(len(done), total, step.estimate.state)
    return done


def _summed(frames: Sequence[_Metered], count: int = 1) -> dict[str, Tally]:
    """Sums over frames, divided by ``count``; empty without frames."""
    out: dict[str, Tally] = {}
    for frame in frames:
        for name, tally in frame.tallies.items():
            total = out.setdefault(name, Tally())
            total.calls += tally.calls / count
            total.images += tally.images / count
            total.seconds += tally.seconds / count
    return out


def _is_learned(config: HatConfig) -> bool:
    return bool({config.segmentation.backend, config.slam.backend, config.hypotheses.backend} & LEARNED)


def _device(config: HatConfig) -> tuple[Callable[[], None], str, Callable[[], float]]:
    """How to wait for the device, its name, and how to ask for its peak memory; torch only where a network runs."""
    if not _is_learned(config):
        return (lambda: None), "the CPU", lambda: float("nan")
    try:
        import torch

        from hat_ros.nets.runtime import choose_device
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"profiling this configuration needs the package '{error.name}', which is not installed: "
            f"run `make install-nets` (or `pip install 'hat_ros[nets]'`)"
        ) from None
    device = choose_device(config.nets.device)
    if device.type == "cpu":
        return (lambda: None), f"the CPU, {torch.get_num_threads()} threads", lambda: float("nan")
    torch.cuda.reset_peak_memory_stats(device)
    name = torch.cuda.get_device_name(device)
    return (lambda: torch.cuda.synchronize(device)), name, lambda: torch.cuda.max_memory_allocated(device) / 2**20
