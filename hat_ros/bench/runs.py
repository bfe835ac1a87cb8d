"""From a recording to a finished result folder: in this process (``hat track``) or by the graph (``hat replay``)."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hat_ros.app.pipeline import MEASURED, WARMUP_FRAMES, Pipeline, latency_summary, memory_summary
from hat_ros.bench.evaluation.folder import complete_folder
from hat_ros.bench.evaluation.metrics import mask_summary
from hat_ros.bench.evaluation.silhouettes import Silhouettes
from hat_ros.bench.methods import create_method
from hat_ros.bench.source import Source, SourceSpec
from hat_ros.config import HatConfig
from hat_ros.errors import HatError, MissingDependencyError, RunError, UsageError
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.provenance import describe_run
from hat_ros.io.result_bag import ResultBagWriter, read_stage_ms
from hat_ros.io.results import RUN_FILE, LiveTables, ResultFolder, write_config, write_json, write_overlaps
from hat_ros.tracker import Step
from hat_ros.types import TrackState

if TYPE_CHECKING:
    from hat_ros.ros.graph import ReplayResult

# Segmentation backends that pass on what the recording brings; all others must find the target themselves.
GIVEN_MASK_BACKENDS = ("annotated",)

# Frames in flight in this process: a second one fills the waits of the first, more only wait for the interpreter lock.
DEFAULT_CREDITS = 2

Watcher = Callable[[int, int, TrackState], None]


@dataclass(frozen=True)
class TrackOptions:
    """How to run, as opposed to what the method is.

    Attributes:
        mode: ``hat``, ``independent``, ``tracking`` or ``offline``.
        start: frames skipped at the beginning (a cold start later in the clip).
        limit: at most this many frames, None = all.
        credits: W, frames in flight, each in a thread; None = 2, or the configuration's if that is less.
        video: write the overlay video.
        report: write ``report.html``.
        overwrite: replace a finished result folder.
    """

    mode: str = "hat"
    credits: int | None = None
    start: int = 0
    limit: int | None = None
    video: bool = True
    report: bool = True
    overwrite: bool = False


def track(spec: SourceSpec, out: Path, config: HatConfig, options: TrackOptions, watch: Watcher | None = None) -> Path:
    """Run a method over a recording and write its result folder.

    Args:
        spec: the recording.
        out: result folder to be.
        config: configuration of all stages.
        options: see :class:`TrackOptions`.
        watch: called with frames done, frames in all and the newest state.

    Returns:
        The finished folder.

    Raises:
        InputError: the recording, the CAD model, the configuration or ``out`` is bad.
        RunError: the run stopped half-way; what was done is in ``<out>.partial``.
    """
    if options.credits is not None:
        config = replace(config, graph=replace(config.graph, credits_replay=options.credits))
    folder = ResultFolder(out, options.overwrite)
    source = spec.open()
    if source.count(options.start, options.limit) == 0:
        raise UsageError(f"{spec.path} has {source.count()} frames, --start {options.start} leaves none")
    masks_given = config.segmentation.backend in GIVEN_MASK_BACKENDS
    credits = options.credits or min(DEFAULT_CREDITS, config.graph.credits_replay)
    pipeline = Pipeline(partial(create_method, options.mode, config, source.target), credits)
    how = {"mode": options.mode, "start": options.start, "limit": options.limit}
    with _result_folder(folder, spec, config, how):
        measured = _run(pipeline, source, folder, options, masks_given, watch)
        complete_folder(folder.path, source, measured, video=options.video, report=options.report)
    return folder.final_path


@dataclass(frozen=True)
class ReplayOptions:
    """How to replay.

    Attributes:
        graph: ``processes`` (five) or ``single`` (all nodes in one).
        credits: W, frames in flight; None = the configuration's.
        live: play in real time and let the graph drop what it cannot keep up with.
        rate: speed of live play.
        domain: ROS domain, for nodes of one's own that listen; None = a free one, heard by nobody else.
        start, limit, video, report, overwrite: as in :class:`TrackOptions`.
    """

    graph: str = "processes"
    credits: int | None = None
    live: bool = False
    rate: float = 1.0
    domain: int | None = None
    start: int = 0
    limit: int | None = None
    video: bool = True
    report: bool = True
    overwrite: bool = False


def replay_bag(
    path: Path,
    out: Path,
    config: HatConfig,
    options: ReplayOptions,
    watch: Watcher | None = None,
) -> Path:
    """Play a bag through the ROS graph and write its result folder.

    Args:
        path: the bag.
        out: result folder to be.
        config: configuration of all nodes.
        options: see :class:`ReplayOptions`.
        watch: called with frames done, frames in all and the newest state.

    Raises:
        MissingDependencyError: there is no rclpy.
        InputError, RunError: as in :func:`track`.
    """
    try:
        from hat_ros.ros import graph
    except ImportError as error:
        raise MissingDependencyError(
            f"hat replay needs ROS, which cannot be imported ({error}): source your ROS 2, run `make install` (or "
            f"`pip install 'hat_ros[ros]'`), or use `hat track`, which needs none"
        ) from None
    folder = ResultFolder(out, options.overwrite)
    spec = SourceSpec(path)
    source = spec.open()
    if not isinstance(source.recording, BagReader):
        raise UsageError(f"{path} is no bag: `hat import sequence {path} --out BAG` makes one, `hat track` needs none")
    clock: list[float] = []

    def progress(now: graph.Progress) -> None:
        if now.done >= WARMUP_FRAMES:
            clock.append(time.perf_counter())
        if watch is not None:
            watch(now.done, now.total, now.status.estimate.state)

    how = {"mode": "hat", "graph": options.graph, "live": options.live, "start": options.start, "limit": options.limit}
    with _result_folder(folder, spec, config, how):
        result = graph.replay(
            path,
            config,
            source.recording.target_path,
            folder.bag_path,
            graph=options.graph,
            credits=options.credits,
            live=options.live,
            rate=options.rate,
            domain_id=options.domain,
            first_frame=options.start,
            max_frames=options.limit,
            on_progress=progress,
        )
        measured = _measured_by(result, clock) | _stage_times(folder.bag_path)
        complete_folder(folder.path, source, measured, video=options.video, report=options.report)
    return folder.final_path


def _measured_by(result: ReplayResult, clock: list[float]) -> dict[str, Any]:
    """Speed and memory of a replay, warm-up left out where the run is long enough."""
    latency_ms = result.latency_ms[WARMUP_FRAMES:] if len(result.latency_ms) > WARMUP_FRAMES else result.latency_ms
    fps = (len(clock) - 1) / (clock[-1] - clock[0]) if len(clock) > 1 else result.answered / max(result.wall_s, 1e-9)
    percentiles = np.percentile(latency_ms, (50, 99)) if len(latency_ms) else (np.nan, np.nan)
    return {
        "fps": fps,
        "latency_ms_p50": float(percentiles[0]),
        "latency_ms_p99": float(percentiles[1]),
        "peak_memory_mib": result.peak_memory_mib,
    }


def _stage_times(bag: Path) -> dict[str, float]:
    """Mean time per stage as the nodes measured it, under the names of ``metrics.json``."""
    return {f"{'motion' if node == 'slam' else node}_ms_mean": ms for node, ms in read_stage_ms(bag).items()}


@contextmanager
def _result_folder(folder: ResultFolder, spec: SourceSpec, config: HatConfig, how: dict[str, Any]) -> Iterator[None]:
    """A result folder around a run; one that stops leaves tables and metrics of what was done in ``*.partial``."""
    with folder:
        write_config(folder.path, config)
        write_json(folder.path / RUN_FILE, describe_run(spec.path, spec.sha256(), config, **spec.describe(), **how))
        try:
            yield
        except BaseException as error:
            with suppress(HatError, OSError):
                complete_folder(folder.path, None, {}, video=False, report=False)
            if isinstance(error, OSError):
                reason = error.strerror or type(error).__name__
                raise RunError(f"the run stopped ({reason}); what was done is in {folder.path}") from None
            if isinstance(error, RunError):
                raise type(error)(f"{error}; what was done is in {folder.path}") from None
            raise


def _run(
    pipeline: Pipeline,
    source: Source,
    folder: ResultFolder,
    options: TrackOptions,
    masks_given: bool,
    watch: Watcher | None,
) -> dict[str, Any]:
    """Process all frames, write bag and live tables, return what was measured."""
    rows: list[tuple[float, ...]] = []
    steps: list[Step] = []
    total = source.count(options.start, options.limit)
    with (
        closing(LiveTables(folder.path, MEASURED)) as tables,
        ResultBagWriter(folder.bag_path, source.frame_id, source.target.name) as bag,
        closing(Silhouettes()) as silhouettes,
    ):
        try:
            for done in pipeline.run(source.frames(options.start, options.limit, masks_given)):
                rows.append(done.measured())
                if done.step.detection is not None or done.stage_ms["segmentation"] > 0.0:
                    silhouettes.remember(done.step)
                if pipeline.causal:
                    tables.add(done.step.estimate, rows[-1])
                    bag.write_step(done.step, pipeline.rejected)
                else:
                    steps.append(done.step)
                if watch is not None:
                    watch(len(rows), total, done.step.estimate.state)
            last_answer_s = time.perf_counter()
            final = pipeline.finish(steps)
            finish_s = time.perf_counter() - last_answer_s
            for step, row in zip(final, rows[: len(steps)], strict=True):
                tables.add(step.estimate, row)
                bag.write_step(step, pipeline.rejected)
        finally:
            bag.write_context(source.recording.camera, source.truth_rows())
        overlaps = silhouettes.overlaps(source.masks(options.start, options.limit))
    if not rows:
        raise RunError(f"no frame of {source.path} could be used, {pipeline.rejected} were rejected (stamp or image)")
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    write_overlaps(folder.path, overlaps)
    speed, memory = latency_summary(rows, finish_s), {"peak_memory_mib": peak_mib} | memory_summary(rows)
    return speed | memory | mask_summary(np.array(list(overlaps.values())))
