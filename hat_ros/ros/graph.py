"""Replay of a bag through the real graph: five processes (or one), played, recorded and watched from this one.

Every replay has a ROS domain of its own, so that runs side by side, and a robot on the same network, never mix.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rclpy
import yaml
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from hat_ros.array_types import Float
from hat_ros.config import HatConfig, config_to_dict
from hat_ros.core.refusals import Refusals
from hat_ros.errors import ConfigError
from hat_ros.io.bag_reader import BagReader
from hat_ros.ros.domain import reserved_domain
from hat_ros.ros.environment import keep_large_blocks, replay_environment
from hat_ros.ros.replay_run import Progress, ReplayRun
from hat_ros.ros.stage_processes import STAGES, StageProcesses

__all__ = ["Progress", "ReplayResult", "replay"]


@dataclass(frozen=True)
class ReplayResult:
    """What a replay measured.

    Attributes:
        played: frames sent into the graph.
        answered: statuses that came back.
        dropped: frames that were not admitted (live drops, refused frames).
        refusals: those that were refused.
        wall_s: from the first frame sent to the last status.
        latency_ms: (answered,) from sending a frame to its status.
        peak_memory_mib: sum of the node processes' peak resident memory.
    """

    played: int
    answered: int
    dropped: int
    refusals: Refusals
    wall_s: float
    latency_ms: Float
    peak_memory_mib: float


def replay(
    bag: str | Path,
    config: HatConfig,
    target: str | Path,
    out: str | Path,
    *,
    graph: str = "processes",
    credits: int | None = None,
    live: bool = False,
    rate: float = 1.0,
    stage_delays_ms: Mapping[str, float] | None = None,
    image_topic: str | None = None,
    camera_info_topic: str | None = None,
    first_frame: int = 0,
    max_frames: int | None = None,
    domain_id: int | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> ReplayResult:
    """Play a bag through the graph and record the result bag.

    Args:
        bag: the recording.
        config: configuration of all nodes.
        target: CAD model or ``target.yaml``.
        out: folder of the result bag to be created.
        graph: ``processes`` (five) or ``single`` (all five nodes in one).
        credits: W, frames in flight; None = ``graph.credits_replay``.
        live: play in real time and let the graph drop what it cannot keep up with (W = 1).
        rate: speed of live play relative to the recording.
        stage_delays_ms: stage -> largest random extra time per frame, for latency studies.
        image_topic: see :class:`~hat_ros.io.bag_reader.BagReader`.
        camera_info_topic: likewise.
        first_frame: frames skipped at the beginning.
        max_frames: at most this many frames, None = all.
        domain_id: ROS domain; None takes a free one.
        on_progress: called after each status.

    Returns:
        What was measured. The result bag is complete.

    Raises:
        InputError: bag, configuration or target is bad.
        StageTimeoutError: a stage did not answer; the message names it.
        RunError: a node ended early or failed. The result up to there is in ``out``, readable.
    """
    if graph not in ("processes", "single"):
        raise ConfigError(f"graph must be 'processes' or 'single', found '{graph}'")
    if credits is not None:
        config = replace(config, graph=replace(config.graph, credits_replay=credits))
    reader = BagReader(bag, image_topic=image_topic, camera_info_topic=camera_info_topic, camera_config=config.camera)
    keep_large_blocks()
    with contextlib.ExitStack() as stack:
        stack.enter_context(replay_environment())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hat_replay_")))
        domain = stack.enter_context(reserved_domain(domain_id))
        config_file = folder / "config.yaml"
        config_file.write_text(yaml.safe_dump(config_to_dict(config), sort_keys=False), encoding="utf-8")
        common = {"config": str(config_file), "target": str(Path(target).resolve()), "live": live, "recorded": True}
        recorder = {**common, "out": str(Path(out).resolve())}
        player = {
            **common,
            "recorded": False,
            "bag": str(reader.path.resolve()),
            "image_topic": reader.image_topic,
            "camera_info_topic": reader.camera_info_topic,
            "rate": float(rate),
            "first_frame": first_frame,
            "max_frames": max_frames or 0,
            "wait_for": [*STAGES, "recorder"],
        }
        executor = stack.enter_context(_executor(domain))
        processes = stack.enter_context(contextlib.closing(StageProcesses(folder, domain)))
        processes.start(graph, common, stage_delays_ms or {})
        run = stack.enter_context(contextlib.closing(ReplayRun(executor, processes, reader, recorder, player)))
        run.play(on_progress)
        return _measured(run, processes)


@contextlib.contextmanager
def _executor(domain: int) -> Iterator[SingleThreadedExecutor]:
    context = Context()
    rclpy.init(args=[], context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield SingleThreadedExecutor(context=context)
    finally:
        context.try_shutdown()


def _measured(run: ReplayRun, processes: StageProcesses) -> ReplayResult:
    playback = run.playback
    return ReplayResult(
        played=playback.sent,
        answered=playback.answered,
        dropped=playback.dropped,
        refusals=playback.refusals,
        wall_s=playback.progress_s - min(playback.sent_s.values()) if playback.sent_s else 0.0,
        latency_ms=1e3 * np.array(playback.latency_s),
        peak_memory_mib=processes.peak_memory_mib,
    )
