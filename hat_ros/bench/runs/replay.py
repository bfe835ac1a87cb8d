"""``hat replay``: a bag through the ROS graph."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hat_ros.app.timing import WARMUP_FRAMES
from hat_ros.bench.evaluation.result_folder import complete_folder
from hat_ros.bench.runs.folder import RunOptions, Watcher, no_frame_used, record_frames, result_folder
from hat_ros.bench.source import SourceSpec
from hat_ros.config import HatConfig
from hat_ros.errors import MissingDependencyError, RunError, UsageError
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.result_bag import read_stage_ms
from hat_ros.io.results import ResultFolder

if TYPE_CHECKING:
    from hat_ros.ros.graph import ReplayResult


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(RunOptions):
    """How to replay.

    Attributes:
        graph: ``processes`` (five) or ``single`` (all nodes in one).
        credits: W, frames in flight; None = the configuration's.
        live: play in real time and let the graph drop what it cannot keep up with.
        rate: speed of live play.
        domain: ROS domain, for nodes of one's own that listen; None = a free one.
        image_topic: topic of the images in the bag; None = find it.
        camera_info_topic: topic of the calibration in the bag; None = find it.
    """

    graph: str = "processes"
    credits: int | None = None
    live: bool = False
    rate: float = 1.0
    domain: int | None = None
    image_topic: str | None = None
    camera_info_topic: str | None = None


def replay_bag(path: Path, out: Path, config: HatConfig, options: ReplayOptions, watch: Watcher | None = None) -> Path:
    """Play a bag through the ROS graph and write its result folder.

    Args:
        path: the bag.
        out: result folder to be.
        config: configuration of all nodes.
        options: see :class:`ReplayOptions`.
        watch: called with frames done, frames in all and the newest state.

    Raises:
        MissingDependencyError: there is no rclpy.
        InputError, RunError: as in :func:`hat_ros.bench.runs.track.track`.
    """
    try:
        from hat_ros.ros import graph
    except ImportError as error:
        raise MissingDependencyError(
            f"hat replay needs ROS, which cannot be imported ({error}): source your ROS 2, run `make install` (or "
            f"`pip install 'hat_ros[ros]'`), or use `hat track`, which needs none"
        ) from None
    folder = ResultFolder(out, options.overwrite)
    spec = SourceSpec(path, image_topic=options.image_topic, camera_info_topic=options.camera_info_topic)
    source = spec.open(config.camera)
    if not isinstance(source.recording, BagReader):
        raise UsageError(f"{path} is no bag: `hat import sequence {path} --out BAG` makes one, `hat track` needs none")
    target = source.recording.target_path
    assert target is not None  # the source was opened with it
    clock: list[float] = []

    def progress(now: graph.Progress) -> None:
        if now.done >= WARMUP_FRAMES:
            clock.append(time.perf_counter())
        if watch is not None:
            watch(now.done, now.total, now.status.estimate.state)

    how = {"graph": options.graph, "live": options.live, "start": options.start, "limit": options.limit}
    with result_folder(folder, spec, config, mode="hat", **how):
        result = graph.replay(
            path,
            config,
            target,
            folder.bag_path,
            graph=options.graph,
            credits=options.credits,
            live=options.live,
            rate=options.rate,
            domain_id=options.domain,
            image_topic=source.recording.image_topic,
            camera_info_topic=source.recording.camera_info_topic,
            first_frame=options.start,
            max_frames=options.limit,
            on_progress=progress,
        )
        record_frames(folder.path, result.played, result.refusals)
        if not result.answered and result.refusals.total:
            raise RunError(no_frame_used(path, result.refusals))
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
