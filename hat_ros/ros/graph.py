"""Replay of a bag through the real graph: five processes (or one), played, recorded and watched from this one.

Every replay has a ROS domain of its own, so that runs side by side, and a robot on the same network, never mix.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import rclpy
import yaml
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from hat_ros.array_types import Float
from hat_ros.config import HatConfig, config_to_dict
from hat_ros.errors import ConfigError, HatError, InputError, RunError, StageTimeoutError
from hat_ros.io import topics
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.messages import Status, Wire
from hat_ros.io.rosbag import TYPESTORE
from hat_ros.ros import base
from hat_ros.ros.domain import reserved_domain
from hat_ros.ros.environment import keep_large_blocks, prepare_environment
from hat_ros.ros.player_node import PlayerNode
from hat_ros.ros.process import close as close_nodes
from hat_ros.ros.recorder_node import RecorderNode

LOG = logging.getLogger(__name__)

STAGES = ("segmentation", "hypotheses", "slam", "selector", "fusion")
# What each stage sends for every frame, in the order of the data flow; segmentation's own answer is an image.
_ANSWERS = (
    ("segmentation", topics.ADMISSION),
    ("hypotheses", topics.HYPOTHESES_SCORED),
    ("slam", topics.SLAM_STATE),
    ("selector", topics.SELECTION),
    ("fusion", topics.STATUS),
)
_EXIT_TIMEOUT_S = 20.0


@dataclass(frozen=True)
class Progress:
    """How far a replay is: frames answered of all, and the newest status."""

    done: int
    total: int
    status: Status


@dataclass(frozen=True)
class ReplayResult:
    """What a replay measured.

    Attributes:
        played: frames sent into the graph.
        answered: statuses that came back.
        dropped: frames that were not admitted (live drops, rejected frames).
        wall_s: from the first frame sent to the last status.
        latency_ms: (answered,) from sending a frame to its status.
        peak_memory_mib: sum of the node processes' peak resident memory.
    """

    played: int
    answered: int
    dropped: int
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
        RunError: a node died or failed. The result up to there is in ``out``, readable.
    """
    if graph not in ("processes", "single"):
        raise ConfigError(f"graph must be 'processes' or 'single', found '{graph}'")
    if credits is not None:
        config = replace(config, graph=replace(config.graph, credits_replay=credits))
    reader = BagReader(bag, image_topic=image_topic, camera_info_topic=camera_info_topic)
    prepare_environment()
    keep_large_blocks()
    with tempfile.TemporaryDirectory(prefix="hat_replay_") as scratch, reserved_domain(domain_id) as domain:
        folder = Path(scratch)
        config_file = folder / "config.yaml"
        config_file.write_text(yaml.safe_dump(config_to_dict(config), sort_keys=False), encoding="utf-8")
        common = {"config": str(config_file), "target": str(Path(target).resolve()), "live": live, "recorded": True}
        play = {
            "bag": str(reader.path.resolve()),
            "image_topic": reader.image_topic,
            "camera_info_topic": reader.camera_info_topic,
            "rate": float(rate),
            "first_frame": first_frame,
            "max_frames": max_frames or 0,
            "wait_for": [*STAGES, "recorder"],
        }
        run = _Run(domain, folder, common, play, reader, Path(out).resolve(), on_progress)
        with contextlib.closing(run):
            run.start_nodes(graph, stage_delays_ms or {})
            return run.run()


class _Run:
    """One replay: the node processes, and player and recorder in this process."""

    def __init__(
        self,
        domain: int,
        folder: Path,
        common: dict[str, Any],
        play: dict[str, Any],
        reader: BagReader,
        out: Path,
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        self._domain, self._folder, self._common, self._play = domain, folder, common, play
        self._reader, self._out, self._on_progress = reader, out, on_progress
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._logs: list[IO[bytes]] = []
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._nodes: list[base.HatNode] = []
        self._peak_memory_mib: dict[str, float] = {}
        self._heard: dict[str, str] = {}
        self._next_look_s = 0.0

    def start_nodes(self, graph: str, delays_ms: Mapping[str, float]) -> None:
        """Start the stage processes, then player and recorder here."""
        for name in delays_ms:
            if name not in STAGES:
                raise ConfigError(f"stage_delays_ms: unknown stage '{name}', known are {', '.join(STAGES)}")
        parameters = self._folder / "parameters.yaml"
        supervised = {**self._common, "exit_at_end": True, "supervisor_pid": os.getpid()}
        content: dict[str, Any] = {"/**": {"ros__parameters": supervised}}
        for name, delay_ms in delays_ms.items():
            content[f"/hat/{name}"] = {"ros__parameters": {"graph": {"debug_stage_delay_ms": float(delay_ms)}}}
        parameters.write_text(yaml.safe_dump(content), encoding="utf-8")
        modules = {name: f"{name}_node" for name in STAGES} if graph == "processes" else {"graph": "single"}
        for name, module in modules.items():
            self._start(name, module, parameters)
        self._recorder = RecorderNode(context=self._context, parameters={**self._common, "out": str(self._out)})
        self._add(self._recorder)
        self._player = PlayerNode(context=self._context, parameters={**self._common, **self._play, "recorded": False})
        self._add(self._player)

    def _start(self, name: str, module: str, parameters: Path) -> None:
        log = (self._folder / f"{name}.log").open("wb")
        self._logs.append(log)
        self._processes[name] = subprocess.Popen(
            [sys.executable, "-m", f"hat_ros.ros.{module}", "--ros-args", "--params-file", str(parameters)]
            + ["--disable-external-lib-logs"],
            env={**os.environ, "ROS_DOMAIN_ID": str(self._domain)},
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C is for us: we end the nodes after what they have said is recorded
        )

    def _add(self, node: base.HatNode) -> None:
        self._nodes.append(node)
        self._executor.add_node(node)
        node.start()
        if node.failure is not None:
            raise node.failure

    def run(self) -> ReplayResult:
        """Play to the end."""
        player, done = self._player, 0
        while not player.finished:
            self._executor.spin_once(timeout_sec=0.1)
            self._check()
            self._relay()
            answered = min(player.n_status, self._recorder.counts[topics.STATUS])  # what is reported is also recorded
            if answered != done:
                done = answered
                if self._on_progress is not None:
                    self._on_progress(Progress(done, player.total, player.last_status))
        self._await_exit()
        wall_s = player.progress_s - min(player.sent_s.values()) if player.sent_s else 0.0
        return ReplayResult(
            played=player.published,
            answered=player.n_status,
            dropped=player.dropped,
            wall_s=wall_s,
            latency_ms=1e3 * np.array(player.latency_s),
            peak_memory_mib=sum(self._peak_memory_mib.values()),
        )

    def _check(self) -> None:
        """Whatever went wrong, as one sentence."""
        self._note_memory()
        for name, process in self._processes.items():
            code = process.poll()
            if code is not None and not (code == 0 and self._player.finished):
                raise self._death(name, code)
        for node in self._nodes:
            if isinstance(node.failure, StageTimeoutError) and self._player.published:
                raise StageTimeoutError(f"{node.failure}: {self._culprit()}") from None
            if node.failure is not None:
                raise node.failure

    def _relay(self) -> None:
        """Log here what a node says that is at work on something that takes long."""
        for name, text in self._player.said.items():
            if self._heard.get(name) != text and text.startswith(base.BUSY):
                LOG.info("%s: %s", name, text.removeprefix(base.BUSY))
            self._heard[name] = text

    def _note_memory(self) -> None:
        """Peak memory of the node processes, looked at twice a second."""
        if time.monotonic() < self._next_look_s:
            return
        self._next_look_s = time.monotonic() + 0.5
        for name, process in self._processes.items():
            with contextlib.suppress(OSError, ValueError, StopIteration):
                status = Path(f"/proc/{process.pid}/status").read_text(encoding="ascii")
                line = next(line for line in status.splitlines() if line.startswith("VmHWM:"))
                self._peak_memory_mib[name] = int(line.split()[1]) / 1024

    def _death(self, name: str, code: int) -> HatError:
        lines = (self._folder / f"{name}.log").read_text(encoding="utf-8", errors="replace").split("\n")
        said = next((line.strip() for line in reversed(lines) if line.strip()), "no last words")
        if code == InputError.exit_code:
            return InputError(said)
        if said.endswith(base.HANGS):
            return StageTimeoutError(f"{said.removesuffix(base.HANGS)}{self._culprit()}")
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return RunError(f"node '{name}' {how} after {self._player.n_status} frames: {said}")

    def _culprit(self) -> str:
        """The first stage in the data flow that is behind the one before it."""
        newest, counts = self._recorder.newest_ns, self._recorder.counts
        for name, topic in _ANSWERS:
            if counts[topic] < counts[topics.ADMISSION] or not counts[topic]:
                return f"stage '{name}' has answered {counts[topic]} frames, the last at {newest[topic]} ns"
        return "every stage has answered what was admitted"

    def _await_exit(self) -> None:
        """The stages end once everything that they sent was acknowledged; then the recorder holds it all."""
        limit = time.monotonic() + _EXIT_TIMEOUT_S
        while any(process.poll() is None for process in self._processes.values()):
            self._executor.spin_once(timeout_sec=0.05)
            self._check()
            if time.monotonic() > limit:
                raise RunError(f"the nodes did not end within {_EXIT_TIMEOUT_S:g} s after the end of the stream")
        while self._recorder.counts[topics.STATUS] < self._player.n_status and time.monotonic() < limit:
            self._executor.spin_once(timeout_sec=0.05)
        self._drain()
        self._check()

    def _drain(self) -> None:
        """Record what has arrived and lies in the readers' queues."""
        idle = 0
        while idle < 3:
            before = sum(self._recorder.counts.values())
            self._executor.spin_once(timeout_sec=0.02)
            idle = 0 if sum(self._recorder.counts.values()) > before else idle + 1

    def close(self) -> None:
        """Record what has arrived, end every process that is left, put the truth into the record, close the bag."""
        recording = len(self._nodes) == 2
        with contextlib.ExitStack() as stack:  # each of these, last first, whatever happens to the others
            stack.callback(self._context.try_shutdown)
            stack.callback(close_nodes, self._executor, self._nodes)
            if recording:
                stack.callback(self._record_truth)
            stack.callback(self._end_processes)
            if recording:
                self._player.active = False
                self._drain()  # before the writers go: their unread messages go with them

    def _end_processes(self) -> None:
        for process in self._processes.values():
            if process.poll() is None:
                process.terminate()
        for process in self._processes.values():
            try:
                process.wait(timeout=3.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for log in self._logs:
            log.close()

    def _record_truth(self) -> None:
        """The truth goes from the bag into the record, past every node."""
        first, last = self._recorder.span_ns
        make = Wire.bag(TYPESTORE)
        for stamp_ns, row in sorted(self._reader.truth_rows().items()):
            if first <= stamp_ns <= last:
                message = make.pose(stamp_ns, self._reader.frame_id, row)
                self._recorder.writer.write_message(topics.GROUND_TRUTH, message, stamp_ns)
