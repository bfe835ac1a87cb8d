"""From a recording to a finished result folder, in this process (``hat track``); and the last steps of any run."""

from __future__ import annotations

import json
import resource
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hat_ros.config import HatConfig
from hat_ros.errors import BagError, HatError, RunError, UsageError
from hat_ros.evaluation.figures import error_figure, image_bytes, range_figure
from hat_ros.evaluation.metrics import mask_summary
from hat_ros.evaluation.overlay import OverlayPainter, VideoFile
from hat_ros.evaluation.report import write_report
from hat_ros.evaluation.runlog import RunLog
from hat_ros.evaluation.score import score_run, write_json
from hat_ros.methods import create_method
from hat_ros.pipeline import MEASURED, Pipeline, Processed, Source, latency_summary, open_source
from hat_ros.provenance import describe_run
from hat_ros.result_bag import ResultBagWriter, read_result_bag
from hat_ros.results import (
    BAG_FOLDER,
    CONFIG_FILE,
    METRICS_FILE,
    RUN_FILE,
    LiveTables,
    ResultFolder,
    write_config,
    write_tables,
)
from hat_ros.tracker import Step
from hat_ros.types import Frame, TrackState

# Segmentation backends that pass on what the recording brings; all others must find the target themselves.
GIVEN_MASK_BACKENDS = ("annotated",)
STRIP_FRAMES = 12

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
    pipeline = Pipeline(method, config.segmentation.backend in GIVEN_MASK_BACKENDS)
    with folder:
        begin_folder(folder.path, path, config, mode=options.mode, start=options.start, limit=options.limit)
        try:
            measured = _run(pipeline, source, folder, options, watch)
            complete_folder(folder.path, source, measured, video=options.video, report=options.report)
        except OSError as error:
            raise RunError(f"the run stopped ({error.strerror}); what was done is in {folder.path}") from None
    return folder.final_path


def begin_folder(folder: Path, recording: Path, config: HatConfig, **how: Any) -> None:
    """Write what is known before a run: ``config.yaml`` and ``run.json``."""
    write_config(folder, config)
    write_json(folder / RUN_FILE, describe_run(recording, config, **how))


def _run(
    pipeline: Pipeline, source: Source, folder: ResultFolder, options: TrackOptions, watch: Watcher | None
) -> dict[str, Any]:
    """Process all frames, write bag and live tables, return what was measured."""
    rows: list[tuple[float, ...]] = []
    steps: list[Step] = []
    total = source.count(options.start, options.limit)
    with (
        closing(LiveTables(folder.path, MEASURED)) as tables,
        ResultBagWriter(folder.bag_path, source.frame_id, source.target.name) as bag,
    ):
        try:
            for done in pipeline.run(source.frames(options.start, options.limit)):
                rows.append(done.measured())
                if pipeline.causal:
                    tables.add(done.step.estimate, rows[-1])
                    bag.write_step(done.step, pipeline.rejected)
                else:
                    steps.append(done.step)
                if watch is not None:
                    watch(done, total)
            for step, row in zip(pipeline.finish(steps), rows[: len(steps)], strict=True):
                tables.add(step.estimate, row)
                bag.write_step(step, pipeline.rejected)
        finally:
            bag.write_context(source.recording.camera, source.truth_rows())
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    overlap = np.array([row[MEASURED.index("mask_iou")] for row in rows])
    return latency_summary(rows) | mask_summary(overlap) | {"peak_memory_mib": peak_mib}


def complete_folder(folder: Path, source: Source | None, measured: dict[str, Any], video: bool, report: bool) -> None:
    """Derive everything else of a result folder from its bag: tables, metrics, report, overlay.

    Args:
        folder: holds ``bag``, ``config.yaml`` and ``run.json``.
        source: the recording, for overlay and ADD-S; None leaves both out.
        measured: what the run itself measured (speed, memory, masks); goes into ``metrics.json``.
        video: write the overlay video.
        report: write ``report.html``.

    Raises:
        BagError: the result bag is missing or damaged.
    """
    log = read_result_bag(folder / BAG_FOLDER)
    figures = score_run(log, source.target if source else None) | measured
    write_tables(folder, log)
    write_json(folder / METRICS_FILE, figures)
    strip = paint_overlay(folder, source, log, video) if source and (video or report) else []
    if report:
        _report(folder, log, figures, strip)


def evaluate_folder(folder: Path, truth: Path | None = None) -> None:
    """Score a finished run again, perhaps against another truth, and rewrite tables, metrics and report.

    Args:
        folder: result folder; what the run itself measured is kept from its ``metrics.json``.
        truth: recording whose truth counts; by default the one that is in the result bag.

    Raises:
        UsageError: it is no result folder.
        BagError: a bag is damaged, or the recording has no truth for these frames.
    """
    run, figures, _ = read_folder(folder)
    log = read_result_bag(folder / BAG_FOLDER)
    source = open_source(truth) if truth is not None else _source_of(run)
    if truth is not None:
        first, last = int(log.stamp_ns[0]), int(log.stamp_ns[-1])
        log = log.with_truth({stamp: row for stamp, row in source.truth_rows().items() if first <= stamp <= last})
        if not log.has_truth.any():
            raise BagError(f"{truth} has no true pose at any stamp of {folder}: is it the recording of this run?")
    figures |= score_run(log, source.target if source else None)
    write_tables(folder, log)
    write_json(folder / METRICS_FILE, figures)
    _report(folder, log, figures, paint_overlay(folder, source, log, video=False) if source else [])


def plot_folder(folder: Path, out: Path, form: str) -> list[Path]:
    """Draw a finished run into image files of the given format; returns their paths."""
    _, figures, _ = read_folder(folder)
    log = read_result_bag(folder / BAG_FOLDER)
    drawn = {"errors": error_figure(log)}
    if figures.get("range_bins"):
        drawn["range"] = range_figure(figures["range_bins"])
    paths = [out / f"{name}.{form}" for name in drawn]
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path, figure in zip(paths, drawn.values(), strict=True):
            path.write_bytes(image_bytes(figure, form))
    except OSError as error:
        raise RunError(f"cannot write {out}: {error.strerror}") from None
    return paths


def read_folder(folder: Path) -> tuple[dict[str, Any], dict[str, Any], str]:
    """``run.json``, ``metrics.json`` and ``config.yaml`` of a result folder.

    Raises:
        UsageError: one of them is missing or unreadable.
    """
    try:
        run = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
        figures = json.loads((folder / METRICS_FILE).read_text(encoding="utf-8"))
        return run, figures, (folder / CONFIG_FILE).read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not valid JSON"
        raise UsageError(f"{folder} is no finished result folder ({reason}): give the --out of a run") from None


def _source_of(run: dict[str, Any]) -> Source | None:
    """The recording that a run was made from, None when it is no longer there."""
    try:
        return open_source(run["source"])
    except HatError:
        return None


def _report(folder: Path, log: RunLog, figures: dict[str, Any], strip: list[tuple[str, NDArray[np.uint8]]]) -> None:
    run, _, config_text = read_folder(folder)
    title = f"{Path(run['source']).name}: {run.get('mode', 'hat')}"
    write_report(folder / "report.html", title, log, figures, run, config_text, strip)


def paint_overlay(folder: Path, source: Source, log: RunLog, video: bool) -> list[tuple[str, NDArray[np.uint8]]]:
    """Draw the run into its images: the video, and captioned frames for the report."""
    wanted = (
        {int(log.stamp_ns[i]) for i in np.linspace(0, len(log) - 1, STRIP_FRAMES).astype(int)} if len(log) else set()
    )
    index = {int(stamp): i for i, stamp in enumerate(log.stamp_ns)}
    painter = OverlayPainter(source.target)
    camera = source.recording.camera
    period = np.median(np.diff(log.stamp_ns)) * 1e-9 if len(log) > 1 else 0.1
    file = (
        VideoFile(folder / "overlay", camera.width, camera.height, float(np.clip(1 / period, 1, 60))) if video else None
    )
    strip = []
    for frame in source.frames():
        i = index.pop(frame.stamp_ns, None) if isinstance(frame, Frame) else None
        if i is None or not (video or frame.stamp_ns in wanted):
            continue
        note = f"{(log.stamp_ns[i] - log.stamp_ns[0]) * 1e-9:.1f} s"
        pose_row = log.pose_rows[i] if log.has_output[i] else np.full(7, np.nan)
        image = painter.paint(frame.rgb, camera, TrackState(int(log.state[i])), pose_row, note, log.truth_rows[i])
        if file is not None:
            file.add(image)
        if frame.stamp_ns in wanted:
            scale = min(1.0, 640 / camera.width)
            strip.append((f"{note}, {TrackState(int(log.state[i])).name}", cv2.resize(image, None, fx=scale, fy=scale)))
    if file is not None:
        file.close()
    return strip
