"""``hat profile``: network passes, renders and time per keyframe, counted and measured from outside.

What is measured is wrapped while a :class:`Meter` is open; the algorithms know nothing of it and read no clock. On an
accelerator every measured call waits for the device before and after, so that the time belongs to the part it stands
beside. Stages run one after another here; ``hat track`` and the graph let them overlap, so their throughput is higher.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from types import TracebackType
from typing import Any

from hat_ros.bench.evaluation.tables import Column, Table
from hat_ros.bench.runs.folder import Watcher
from hat_ros.bench.runs.track import GIVEN_MASK_BACKENDS
from hat_ros.bench.source import Source
from hat_ros.config import HatConfig
from hat_ros.errors import MissingDependencyError, UsageError
from hat_ros.tracker import HatTracker
from hat_ros.types import Frame


@dataclass(frozen=True)
class Part:
    """Something whose calls are counted and timed.

    Attributes:
        name: for tables; parts of a stage are indented below it.
        where: ``module:function`` or ``module:Class.method``, where callers look it up.
        counted: which argument (``self`` apart) has as many rows as there are images, or is a list of such; None counts
            each call as one.
    """

    name: str
    where: str
    counted: int | None = None


_TEMPLATES = Part("  templates rendered", "hat_ros.target.network_views:NetworkViewRenderer.render")
_TRANSFORMER = Part("  transformer", "hat_ros.nets.dinov2:DinoV2.forward", 0)
_MEGAPOSE = (
    Part("  renders", "hat_ros.target.network_views:NetworkViewRenderer.render_many", 0),
    Part("  crops", "hat_ros.nets.megapose:roi_align", 1),
    Part("  coarse network", "hat_ros.nets.megapose:CoarseNet.forward", 0),
    Part("  refiner network", "hat_ros.nets.megapose:RefinerNet.forward", 0),
)
PARTS = {
    "mask2former": (
        Part("  resize", "transformers:Mask2FormerImageProcessorPil.__call__"),
        Part("  network", "transformers:Mask2FormerForUniversalSegmentation.forward"),
        Part("  choice", "hat_ros.segmentation.mask2former:choose"),
    ),
    "megapose": _MEGAPOSE,
    "picopose": (
        _TEMPLATES,
        _TRANSFORMER,
        Part("  retrieval", "hat_ros.nets.picopose:match_templates"),
        Part("  affine network", "hat_ros.nets.picopose:AffineRegressor.forward", 0),
        Part("  feature head", "hat_ros.nets.picopose_offset:DptHead.forward", 0),
        Part("  flow decoder", "hat_ros.nets.picopose_offset:FlowDecoder.forward", 0),
        Part("  PnP", "hat_ros.hypotheses.picopose:solve_pose"),
    ),
    "gigapose": (
        _TEMPLATES,
        _TRANSFORMER,
        Part("  second network", "hat_ros.nets.gigapose:IstBackbone.forward", 0),
        Part("  matching", "hat_ros.nets.gigapose:match"),
        *_MEGAPOSE,
    ),
    "droid": (
        Part("  feature network", "hat_ros.nets.droid:DroidNet.features", 0),
        Part("  context network", "hat_ros.nets.droid:DroidNet.context", 0),
        Part("  correlation", "hat_ros.nets.droid:DroidNet.correlation", 0),
        Part("  correlation look-up", "hat_ros.nets.droid:Correlation.lookup", 0),
        Part("  update operator", "hat_ros.nets.droid:DroidNet.refine", 0),
        Part("  bundle adjustment", "hat_ros.motion.droid_graph:bundle_adjust"),
    ),
}


def parts_of(config: HatConfig) -> tuple[Part, ...]:
    """The stages of a configuration, each followed by the parts of its backend."""
    return (
        Part("segmentation", "hat_ros.segmentation.stage:SegmentationStage.update"),
        *PARTS.get(config.segmentation.backend, ()),
        Part("motion", "hat_ros.motion.stage:MotionStage.update"),
        *PARTS.get(config.slam.backend, ()),
        Part("hypotheses", "hat_ros.hypotheses.stage:HypothesisStage.update"),
        *PARTS.get(config.hypotheses.backend, ()),
        Part("selector", "hat_ros.core.selector:SelectorStage.update"),
        Part("fusion", "hat_ros.core.fusion:FusionStage.update"),
    )


@dataclass
class Tally:
    """Calls of one part, the images in them, and their wall time; sums, or means over frames."""

    calls: float = 0
    images: float = 0
    seconds: float = 0.0


class Meter:
    """Counts and times parts while it is open (a context manager).

    Args:
        parts: what to measure; their modules are imported.
        wait: called before each reading of the clock, so that work handed to a device is done.

    Raises:
        MissingDependencyError: a part belongs to a package that is not installed.
    """

    def __init__(self, parts: Sequence[Part], wait: Callable[[], None]) -> None:
        self._parts, self._wait = parts, wait
        self._tallies = {part.name: Tally() for part in parts}
        self._places = [_place(part) for part in parts]
        self._replaced: list[tuple[Any, str, Any]] = []

    def __enter__(self) -> Meter:
        for part, (owner, name) in zip(self._parts, self._places, strict=True):
            self._replaced.append((owner, name, vars(owner).get(name)))
            setattr(owner, name, self._measured(part, getattr(owner, name), isinstance(owner, type)))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for owner, name, original in reversed(self._replaced):
            if original is None:
                delattr(owner, name)  # inherited
            else:
                setattr(owner, name, original)
        self._replaced.clear()

    def take(self) -> dict[str, Tally]:
        """Tallies by part since the last call."""
        taken, self._tallies = self._tallies, {part.name: Tally() for part in self._parts}
        return taken

    def _measured(self, part: Part, call: Callable[..., Any], is_method: bool) -> Callable[..., Any]:
        index = None if part.counted is None else part.counted + is_method

        @wraps(call)
        def measured(*args: Any, **kwargs: Any) -> Any:
            self._wait()
            start = time.perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                self._wait()
                images = 1 if index is None else _rows(args[index])
                tally = self._tallies[part.name]
                tally.calls, tally.images = tally.calls + 1, tally.images + images
                tally.seconds += time.perf_counter() - start

        return measured


def _place(part: Part) -> tuple[Any, str]:
    """The module or class that holds a part, and its name there."""
    module_name, path = part.where.split(":")
    owner: Any = _imported(module_name)
    *outer, name = path.split(".")
    for attribute in outer:
        owner = getattr(owner, attribute)
    return owner, name


def _imported(module_name: str) -> Any:
    try:
        return import_module(module_name)
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"profiling this configuration needs the package '{error.name}', which is not installed: "
            f"run `make install-nets` (or `pip install 'hat_ros[nets]'`)"
        ) from None


def _rows(argument: Any) -> int:
    return len(argument[0] if isinstance(argument, (list, tuple)) else argument)


@dataclass(frozen=True)
class Profile:
    """What a run cost.

    Attributes:
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

    device: str
    start: dict[str, Tally]
    start_s: float
    keyframe: dict[str, Tally]
    between: dict[str, Tally]
    n_keyframes: int
    n_between: int
    fps: float
    device_memory_mib: float
    host_memory_mib: float

    def table(self) -> Table:
        """One row per stage and part: calls, images and milliseconds per keyframe and per frame between."""
        rows = []
        for name, start in self.start.items():
            row: dict[str, Any] = {"part": name, "start_images": start.images, "start_s": start.seconds}
            for label, tallies in (("key", self.keyframe), ("other", self.between)):
                if tallies:
                    tally = tallies[name]
                    row |= {f"{label}_calls": tally.calls, f"{label}_images": tally.images}
                    row[f"{label}_ms"] = 1e3 * tally.seconds
            if any(row.get(f"{label}_images") for label in ("start", "key", "other")):
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
    """Run HAT over a recording with every part metered.

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
    given = config.segmentation.backend in GIVEN_MASK_BACKENDS
    total, done = source.count(0, limit), []
    mark = time.perf_counter()
    with Meter(parts_of(config), wait) as meter:
        tracker = HatTracker(config, source.target)
        for frame in source.frames(0, limit, given):
            if not isinstance(frame, Frame):
                continue
            step = tracker.step(frame)
            before, mark = mark, time.perf_counter()
            done.append(_Metered(len(step.candidates) > 0, mark - before, meter.take()))
            if watch is not None:
                watch(len(done), total, step.estimate.state)
    first = next((index for index, frame in enumerate(done) if frame.keyframe), None)
    if first is None:
        raise UsageError(f"{source.path}: none of {len(done)} frames was a keyframe, so there is nothing to measure")
    opening, later = done[: first + 1], done[first + 1 :]
    keyframes, between = ([frame for frame in later if frame.keyframe is kind] for kind in (True, False))
    busy_s = sum(frame.seconds for frame in later)
    return Profile(
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


def _device(config: HatConfig) -> tuple[Callable[[], None], str, Callable[[], float]]:
    """How to wait for the device, its name, and how to ask for its peak memory; torch only where a network runs."""
    if not {config.segmentation.backend, config.slam.backend, config.hypotheses.backend} & PARTS.keys():
        return (lambda: None), "the CPU", lambda: float("nan")
    torch = _imported("torch")
    device = _imported("hat_ros.nets.runtime").choose_device(config.nets.device)
    if device.type == "cpu":
        return (lambda: None), f"the CPU, {torch.get_num_threads()} threads", lambda: float("nan")
    torch.cuda.reset_peak_memory_stats(device)
    name = torch.cuda.get_device_name(device)
    return (lambda: torch.cuda.synchronize(device)), name, lambda: torch.cuda.max_memory_allocated(device) / 2**20
