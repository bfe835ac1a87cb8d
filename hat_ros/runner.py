"""From a recording to a finished result folder, in this process (``hat track``)."""

from __future__ import annotations

import resource
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hat_ros import lie
from hat_ros.config import HatConfig
from hat_ros.errors import RunError
from hat_ros.evaluation.runlog import RunLog, RunLogBuilder
from hat_ros.evaluation.score import score_run, write_json
from hat_ros.methods import create_method
from hat_ros.pipeline import MEASURED, Pipeline, Processed, Source, latency_summary, open_source
from hat_ros.provenance import describe_run
from hat_ros.results import METRICS_FILE, RUN_FILE, LiveTables, ResultFolder, write_config, write_tables

# Segmentation backends that pass on what the recording brings; all others must find the target themselves.
GIVEN_MASK_BACKENDS = ("annotated",)

Watcher = Callable[[Processed, int], None]


@dataclass(frozen=True)
class TrackOptions:
    """How to run, as opposed to what the method is.

    Attributes:
        mode: ``hat``, ``independent``, ``tracking`` or ``offline``.
        start: frames skipped at the beginning (a cold start later in the clip).
        limit: at most this many frames, None = all.
        video: write the overlay video.
        report: write ``report.html``.
        overwrite: replace a finished result folder.
    """

    mode: str = "hat"
    start: int = 0
    limit: int | None = None
    video: bool = True
    report: bool = True
    overwrite: bool = False


def track(path: Path, out: Path, config: HatConfig, options: TrackOptions, watch: Watcher | None = None) -> Path:
    """Run a method over a recording and write its result folder.

    Args:
        path: bag or sequence folder.
        out: result folder to be.
        config: configuration of all stages.
        options: see :class:`TrackOptions`.
        watch: called after every frame with what came of it and the number of frames in all.

    Returns:
        The finished folder.

    Raises:
        InputError: the recording, the CAD model, the configuration or ``out`` is bad.
        RunError: the run stopped half-way; what was done is in ``<out>.partial``.
    """
    folder = ResultFolder(out, options.overwrite)
    source = open_source(path)
    method = create_method(options.mode, config, source.target)
    with folder:
        write_config(folder.path, config)
        write_json(
            folder.path / RUN_FILE,
            describe_run(path, config, mode=options.mode, start=options.start, limit=options.limit),
        )
        pipeline = Pipeline(method, config.segmentation.backend in GIVEN_MASK_BACKENDS)
        try:
            log, measured = _collect(pipeline, source, folder.path, options, watch)
        except OSError as error:
            raise RunError(f"{error.strerror}: the run stopped, what was done is in {folder.path}") from None
        figures = score_run(log, source.target) | measured
        write_tables(folder.path, log)
        write_json(folder.path / METRICS_FILE, figures)
    return folder.final_path


def _collect(
    pipeline: Pipeline, source: Source, path: Path, options: TrackOptions, watch: Watcher | None
) -> tuple[RunLog, dict[str, Any]]:
    builder, rows = RunLogBuilder(), []
    total = source.count(options.start, options.limit)
    tables = LiveTables(path, MEASURED)
    stamps = []
    try:
        for done in pipeline.run(source.frames(options.start, options.limit)):
            step = done.step
            builder.add(step.candidates, step.motion, step.estimate)
            rows.append(done.measured())
            stamps.append(done.frame.stamp_ns)
            tables.add(step.estimate, rows[-1])
            if watch is not None:
                watch(done, total)
    finally:
        tables.close()
    builder.revise(pipeline.finish())
    builder.dropped_total = pipeline.admission.rejected
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    measured = latency_summary(rows) | {"peak_memory_mib": peak_mib}
    first, last = (stamps[0], stamps[-1]) if stamps else (0, -1)
    truth = {stamp: lie.row_from_matrix(T) for stamp, T in source.recording.truth().items() if first <= stamp <= last}
    return builder.build(truth), measured
