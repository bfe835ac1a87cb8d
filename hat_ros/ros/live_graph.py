"""A live graph in processes of its own, a camera that feeds it, and an observer in this process."""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
import yaml
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from hat_ros.config import HatConfig, config_to_dict
from hat_ros.errors import RunError
from hat_ros.io import messages, topics
from hat_ros.io.messages import message_class
from hat_ros.ros import qos
from hat_ros.ros.domain import reserved_domain
from hat_ros.ros.environment import replay_environment
from hat_ros.ros.live_watch import Moment, Watched
from hat_ros.ros.stage_processes import STAGES, StageProcesses

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Cost:
    """What the processes of a graph use.

    Attributes:
        cpu_s: processor time since their start, seconds, by name.
        pss_mib: proportional set size, by name: pages that processes share are counted once.
    """

    cpu_s: dict[str, float]
    pss_mib: dict[str, float]


class LiveGraph:
    """The stages in live mode; what dies is started again, as the launch file does.

    Args:
        config: configuration of all nodes.
        target: CAD model or ``target.yaml``.
        graph: ``processes`` (five) or ``single``.
        folder: for parameter files and logs; of this graph alone.
        domain: ROS domain.

    Attributes:
        watched: what has been heard so far.
        revived: names of the processes that were started again.
    """

    def __init__(self, config: HatConfig, target: Path, graph: str, folder: Path, domain: int) -> None:
        config_file = folder / "config.yaml"
        config_file.write_text(yaml.safe_dump(config_to_dict(config), sort_keys=False), encoding="utf-8")
        self._common = {"config": str(config_file), "target": str(target.resolve()), "live": True}
        self._graph, self._domain = graph, domain
        self.watched = Watched()
        self.revived: list[str] = []
        self.processes = StageProcesses(folder, domain)
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._node = self._observer()

    def _observer(self) -> Node:
        node = rclpy.create_node("hat_bench", context=self._context)
        self._executor.add_node(node)
        for topic, heard in (
            (topics.STATUS, self._on_status),
            (topics.TARGET_POSE, self._on_pose),
            (topics.DIAGNOSTICS, self._on_diagnostics),
        ):
            node.create_subscription(message_class(topics.TYPES[topic]), topic, heard, qos.profile_of(topic))
        return node

    def start(self) -> None:
        """Start the stages."""
        self.processes.start(self._graph, self._common, {})

    def start_camera(self, bag: Path, name: str = "camera", **parameters: Any) -> None:
        """Start a camera; ``parameters`` are those of :mod:`hat_ros.ros.camera_node`."""
        self.processes.add(name, "camera_node", {"bag": str(bag.resolve()), **parameters})

    def kill(self, name: str) -> Moment:
        """Kill a process, as -9 does; when that was."""
        os.kill(self.processes.pid(name), signal.SIGKILL)
        return Moment()

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Listen and start again what dies, for a time, or until a condition holds.

        Raises:
            RunError: a process was given bad input.
        """
        end = time.monotonic() + seconds
        while time.monotonic() < end and not until():
            self._executor.spin_once(timeout_sec=0.05)
            self.revived += self.processes.revive()
            ended = self.processes.ended()
            if ended is not None and ended[1]:
                raise self.processes.cause_of_end(*ended, len(self.watched.statuses), "")

    def await_pose(self, since: Moment, limit_s: float) -> float:
        """Wait for the pose of an image taken after a moment; seconds from then to its arrival.

        Raises:
            RunError: there is none in time.
        """
        left_s = limit_s - (time.monotonic() - since.steady_s)
        self.run(left_s, lambda: self.watched.first_pose_since(since) is not None)
        found = self.watched.first_pose_since(since)
        if found is None:
            raise RunError(f"no pose within {limit_s:g} s; the nodes last said: {self.last_words()}")
        return found

    def last_words(self) -> str:
        """The newest text of each node's diagnostics."""
        return "; ".join(f"{name}: {text}" for name, text in {r[1]: r[3] for r in self.watched.reports}.items())

    def worst_words(self, node: str, since: Moment) -> str:
        """What a node reported at the highest level after a moment."""
        said = [r for r in self.watched.reports if r[0] > since.steady_s and r[1] == f"hat: {node}"]
        return max(said, key=lambda report: report[2])[3] if said else ""

    def cost(self) -> Cost:
        """What the stages use now; a camera is left out."""
        names = STAGES if self._graph == "processes" else ("graph",)
        cpu_s, pss_mib = {}, {}
        for name in names:
            folder = Path(f"/proc/{self.processes.pid(name)}")
            fields = (folder / "stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
            cpu_s[name] = (int(fields[11]) + int(fields[12])) / _TICKS_PER_S
            rollup = (folder / "smaps_rollup").read_text(encoding="ascii").splitlines()
            pss_mib[name] = next(int(line.split()[1]) for line in rollup if line.startswith("Pss:")) / 1024
        return Cost(cpu_s, pss_mib)

    def close(self) -> None:
        """End all processes; harmless when it was done."""
        self.processes.close()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _on_status(self, message: Any) -> None:
        estimate = messages.status_from(message).estimate
        latency_s = 1e-9 * (time.time_ns() - estimate.stamp_ns)
        self.watched.statuses.append((time.monotonic(), latency_s, estimate.stamp_ns, int(estimate.state)))

    def _on_pose(self, message: Any) -> None:
        self.watched.poses.append((time.monotonic(), messages.stamp_of(message)))

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            self.watched.reports.append((time.monotonic(), status.name, status.level[0], status.message))


@contextlib.contextmanager
def live_graph(config: HatConfig, target: Path, graph: str = "processes") -> Iterator[LiveGraph]:
    """A live graph in a ROS domain of its own, not started yet; everything is ended and removed at the end."""
    with (
        replay_environment(),
        tempfile.TemporaryDirectory(prefix="hat_live_") as folder,
        reserved_domain(None) as domain,
    ):
        live = LiveGraph(config, target, graph, Path(folder), domain)
        try:
            yield live
        finally:
            live.close()
