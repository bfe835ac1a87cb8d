"""The last steps of any run, and what can be done with a finished one: everything derived from the result bag."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hat_ros.app.overlay import OverlayPainter, VideoFile
from hat_ros.array_types import Float, UInt8
from hat_ros.bench.evaluation.figures import error_figure, image_bytes, range_figure
from hat_ros.bench.evaluation.metrics import pose_errors
from hat_ros.bench.evaluation.report import write_report
from hat_ros.bench.evaluation.score import score_run
from hat_ros.bench.evaluation.symmetric import errors_to_nearest, nearest_truth
from hat_ros.bench.observations import save_observations
from hat_ros.bench.source import Source, SourceSpec, open_source
from hat_ros.config import CameraConfig, load_config
from hat_ros.errors import BagError, ConfigError, FrameError, HatError, RunError, UsageError
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry
from hat_ros.io.result_bag import read_result_bag
from hat_ros.io.results import BAG_FOLDER, CONFIG_FILE, METRICS_FILE, RUN_FILE, tum_line, write_json
from hat_ros.io.run_log import RunLog
from hat_ros.target.exact_symmetry import symmetry_of
from hat_ros.types import Frame, StateReason, TrackState

POSE_COLUMNS = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
CSV_COLUMNS = (
    "stamp_ns",
    "state",
    *POSE_COLUMNS,
    "keyframe",
    "n_candidates",
    "anchor",
    "gap_frames",
    "E_t_m",
    "E_q_deg",
    "E_p",
    "reason",
    "E_p_sym",
)

POSES_FILE = "poses.csv"
OBSERVATIONS_FILE = "observations.npz"
# Overlay frames shown in the report.
STRIP_FRAMES = 12
_STRIP_WIDTH_PX = 640


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
    run = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
    figures = _score(log, source, run) | measured
    write_tables(folder, log, _symmetry(source))
    if run.get("mode") == "observe":
        save_observations(folder / OBSERVATIONS_FILE, log)
    write_json(folder / METRICS_FILE, figures)
    strip = paint_overlay(folder, source, log, video) if source and (video or report) else []
    if report:
        _report(folder, log, figures, strip, _symmetry(source))


def evaluate_folder(
    folder: Path, truth: Path | None = None, image_topic: str | None = None, camera_info_topic: str | None = None
) -> None:
    """Score a finished run again, perhaps against another ground truth, and rewrite tables, metrics and report.

    Args:
        folder: result folder; what the run itself measured is kept from its ``metrics.json``.
        truth: recording whose ground truth counts; by default that in the result bag.
        image_topic: topic of the images, where that recording is a bag; None = find it.
        camera_info_topic: likewise of the calibration.

    Raises:
        UsageError: it is no result folder.
        BagError: a bag is damaged, or the recording has no ground truth for these frames.
    """
    run, figures, _ = read_folder(folder)
    log = read_result_bag(folder / BAG_FOLDER)
    if truth is None:
        source = _source_of(run, folder)
    else:
        source = open_source(
            truth, camera_config=_camera_of(folder), image_topic=image_topic, camera_info_topic=camera_info_topic
        )
    if truth is not None and source is not None:
        first, last = int(log.stamp_ns[0]), int(log.stamp_ns[-1])
        log = log.with_truth({stamp: row for stamp, row in source.truth_rows().items() if first <= stamp <= last})
        if not log.has_truth.any():
            raise BagError(f"{truth} has no ground truth at any stamp of {folder}: is it the recording of this run?")
    figures |= _score(log, source, run)
    write_tables(folder, log, _symmetry(source))
    write_json(folder / METRICS_FILE, figures)
    _report(folder, log, figures, paint_overlay(folder, source, log, video=False) if source else [], _symmetry(source))


def _score(log: RunLog, source: Source | None, run: dict[str, Any]) -> dict[str, Any]:
    """The figures of a run, with the frames that ``run.json`` says were played and refused."""
    target = source.target if source else None
    camera = None
    if source is not None:
        with suppress(BagError, FrameError):  # a recording that has no one calibration was scored without before
            camera = source.recording.camera
    figures = score_run(log, target, run.get("played"), run.get("refused", 0), camera)
    return figures | {"refused_reasons": run.get("refused_reasons", [])}


def write_tables(path: Path, log: RunLog, symmetry: Symmetry) -> None:
    """``poses.tum`` and ``poses.csv`` of a finished run; ``symmetry`` is that of the target."""
    errors = pose_errors(log.T_est, log.T_true)
    to_nearest = errors_to_nearest(log.T_est, log.T_true, symmetry)
    with (path / "poses.tum").open("w", encoding="utf-8", newline="") as tum:
        for i in map(int, np.flatnonzero(log.has_output)):
            tum.write(tum_line(int(log.stamp_ns[i]), log.pose_rows[i]))
    with (path / POSES_FILE).open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(CSV_COLUMNS)
        for i in range(len(log)):
            pose = log.pose_rows[i] if log.has_output[i] else np.full(7, np.nan)
            table.writerow(
                (
                    int(log.stamp_ns[i]),
                    TrackState(int(log.state[i])).name,
                    *_cells(pose),
                    int(log.keyframe[i]),
                    len(log.candidates[i]),
                    int(log.anchor[i]),
                    int(log.gap_frames[i]),
                    *_cells((errors.translation_m[i], np.degrees(errors.rotation_rad[i]), errors.pose[i])),
                    StateReason(int(log.reason[i])).name,
                    *_cells((to_nearest.pose[i],)),
                )
            )


def read_errors(folder: Path) -> Float:
    """(N, 4) E_t in metres, E_q in degrees, E_p, E_p to the nearest equal of the truth; of every frame, NaN: none.

    As :func:`write_tables` wrote them.
    """
    with (folder / POSES_FILE).open(newline="", encoding="utf-8") as file:
        rows = [[row.get(key) for key in ("E_t_m", "E_q_deg", "E_p", "E_p_sym")] for row in csv.DictReader(file)]
    return np.array([[float(cell) if cell else np.nan for cell in row] for row in rows]).reshape(-1, 4)


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


def _camera_of(folder: Path) -> CameraConfig:
    """What a run was told of the camera; the default where its configuration is none of ours."""
    try:
        return load_config(folder / CONFIG_FILE).camera
    except ConfigError:
        return CameraConfig()


def _source_of(run: dict[str, Any], folder: Path) -> Source | None:
    """The recording that a run was made from, None when it is no longer there."""
    try:
        model = run.get("model")
        spec = SourceSpec(
            Path(run["source"]),
            run.get("dataset", ""),
            run.get("sequence", ""),
            model and Path(model),
            image_topic=run.get("image_topic"),
            camera_info_topic=run.get("camera_info_topic"),
        )
        return spec.open(_camera_of(folder))
    except HatError:
        return None


def _symmetry(source: Source | None) -> Symmetry:
    """Of the target; none where the recording is no longer there."""
    return Symmetry() if source is None else symmetry_of(source.target)


def _report(
    folder: Path, log: RunLog, figures: dict[str, Any], strip: list[tuple[str, UInt8]], symmetry: Symmetry
) -> None:
    run, _, config_text = read_folder(folder)
    if not symmetry.is_trivial:
        log = replace(log, truth_rows=lie.row_from_matrix(nearest_truth(log.T_est, log.T_true, symmetry)))
    title = f"{Path(run['source']).name}: {run.get('mode', 'hat')}"
    write_report(folder / "report.html", title, log, figures, run, config_text, strip)


def paint_overlay(folder: Path, source: Source, log: RunLog, video: bool) -> list[tuple[str, UInt8]]:
    """Draw the run into its images: the video, and captioned frames for the report."""
    if not len(log):
        return []
    wanted = {int(log.stamp_ns[i]) for i in np.linspace(0, len(log) - 1, STRIP_FRAMES).astype(int)}
    index = {int(stamp): i for i, stamp in enumerate(log.stamp_ns)}
    painter, camera = OverlayPainter(source.target), source.recording.camera
    file = VideoFile(folder / "overlay", camera.width, camera.height, _frame_rate(log)) if video else None
    strip = []
    for frame in source.frames():
        if not isinstance(frame, Frame):
            continue
        i = index.pop(frame.stamp_ns, None)
        if i is None or not (video or frame.stamp_ns in wanted):
            continue
        state, note = TrackState(int(log.state[i])), f"{(log.stamp_ns[i] - log.stamp_ns[0]) * 1e-9:.1f} s"
        pose_row = log.pose_rows[i] if log.has_output[i] else np.full(7, np.nan)
        image = painter.paint(frame.rgb, camera, state, pose_row, note, log.truth_rows[i])
        if file is not None:
            file.add(image)
        if frame.stamp_ns in wanted:
            scale = min(1.0, _STRIP_WIDTH_PX / camera.width)
            small = np.asarray(cv2.resize(image, None, fx=scale, fy=scale), np.uint8)
            strip.append((f"{note}, {state.name}", small))
    if file is not None:
        file.close()
    return strip


def _frame_rate(log: RunLog) -> float:
    """Frames per second of the recording, within what players accept."""
    period_s = float(np.median(np.diff(log.stamp_ns))) * 1e-9 if len(log) > 1 else 0.1
    return float(np.clip(1.0 / period_s, 1.0, 60.0))


def _cells(values: Iterable[float]) -> list[str]:
    """Numbers in full precision, an empty cell for NaN."""
    return ["" if np.isnan(value) else repr(float(value)) for value in values]
