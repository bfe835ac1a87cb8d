"""``hat track``: a method over a recording, in this process."""

from __future__ import annotations

import resource
import time
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.app.pipeline import Pipeline
from hat_ros.app.timing import MEASURED, latency_summary, memory_summary
from hat_ros.bench.evaluation.metrics import mask_summary
from hat_ros.bench.evaluation.result_folder import complete_folder
from hat_ros.bench.evaluation.silhouettes import Silhouettes
from hat_ros.bench.methods.modes import FRAMEWISE, create_method
from hat_ros.bench.runs.folder import RunOptions, Watcher, no_frame_used, record_frames, result_folder
from hat_ros.bench.source import Source, SourceSpec
from hat_ros.config import HatConfig
from hat_ros.errors import RunError, UsageError
from hat_ros.io.result_bag import ResultBagWriter
from hat_ros.io.results import BAG_FOLDER, LiveTables, ResultFolder, write_overlaps
from hat_ros.tracker import Step

# Segmentation backends that pass on what the recording brings; all others must find the target themselves.
GIVEN_MASK_BACKENDS = ("annotated",)

# Frames in flight in this process: a second one fills the waits of the first, more only wait for the interpreter lock.
DEFAULT_CREDITS = 2


@dataclass(frozen=True, kw_only=True)
class TrackOptions(RunOptions):
    """How to run, as opposed to what the method is.

    Attributes:
        mode: one of ``hat_ros.bench.methods.modes.MODES``.
        credits: W, frames in flight, each in a thread; None = 2, or the configuration's if that is less.
    """

    mode: str = "hat"
    credits: int | None = None


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
    source = spec.open(config.camera)
    if source.count(options.start, options.limit) == 0:
        raise UsageError(f"{spec.path} has {source.count()} frames, --start {options.start} leaves none")
    masks_given = config.segmentation.backend in GIVEN_MASK_BACKENDS
    credits = options.credits or min(DEFAULT_CREDITS, config.graph.credits_replay)
    pipeline = Pipeline(partial(create_method, options.mode, config, source.target), credits)
    with result_folder(folder, spec, config, mode=options.mode, start=options.start, limit=options.limit) as path:
        frame_id, name, publish = source.frame_id, source.target.name, config.graph.publish_initialising
        bag = ResultBagWriter(path / BAG_FOLDER, frame_id, name, publish)
        measured = _run(pipeline, source, path, bag, options, masks_given, watch)
        complete_folder(path, source, measured, video=options.video, report=options.report)
    return folder.final_path


def _run(
    pipeline: Pipeline,
    source: Source,
    folder: Path,
    bag: ResultBagWriter,
    options: TrackOptions,
    masks_given: bool,
    watch: Watcher | None,
) -> dict[str, Any]:
    """Process all frames, write bag and live tables, return what was measured."""
    rows: list[tuple[float, ...]] = []
    steps: list[Step] = []
    total = source.count(options.start, options.limit)
    with (
        closing(LiveTables(folder, MEASURED)) as tables,
        bag,
        closing(Silhouettes()) as silhouettes,
    ):
        try:
            frames = source.frames(options.start, options.limit, masks_given, options.mode in FRAMEWISE)
            for done in pipeline.run(frames):
                rows.append(done.measured())
                if done.step.detection is not None or done.stage_ms["segmentation"] > 0.0:
                    silhouettes.remember(done.step)
                if pipeline.causal:
                    tables.add(done.step.estimate, rows[-1])
                    bag.write_step(done.step, pipeline.refusals.total)
                else:
                    steps.append(done.step)
                if watch is not None:
                    watch(len(rows), total, done.step.estimate.state)
            last_answer_s = time.perf_counter()
            final = pipeline.finish(steps)
            finish_s = time.perf_counter() - last_answer_s
            for step, row in zip(final, rows[: len(steps)], strict=True):
                tables.add(step.estimate, row)
                bag.write_step(step, pipeline.refusals.total)
        finally:
            record_frames(folder, len(rows) + pipeline.refusals.total, pipeline.refusals)
            bag.write_context(source.recording.camera, source.truth_rows())
        overlaps = silhouettes.overlaps(source.masks(options.start, options.limit))
    if not rows:
        raise RunError(no_frame_used(source.path, pipeline.refusals))
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    write_overlaps(folder, overlaps)
    speed = latency_summary(rows, finish_s, sequential=pipeline.credits == 1)
    memory = {"peak_memory_mib": peak_mib} | memory_summary(rows)
    return speed | memory | mask_summary(np.array(list(overlaps.values())))
