"""The tables of ``hat bench --live``: what a camera's rate costs, and what faults cost."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.bench.evaluation.tables import Column, Table
from hat_ros.config import HatConfig
from hat_ros.errors import InputError, RunError
from hat_ros.io.bag_reader import BagReader
from hat_ros.ros.live_graph import LiveGraph, live_graph
from hat_ros.ros.live_watch import Moment
from hat_ros.ros.stage_processes import STAGES
from hat_ros.target.loading import load_target
from hat_ros.tracker import HatTracker

LOG = logging.getLogger(__name__)

# Nothing that is measured may hang: compiling from an empty cache takes a minute and more.
_LIMIT_S = 180.0
# From the first pose on, before anything is measured: the target is found and the caches of the processor are warm.
_SETTLE_S = 5.0
# Before and after a fault.
_AROUND_S = 4.0
_CAMERA_FAULTS: dict[str, dict[str, Any]] = {
    "clock back by 60 s": {"clock_steps": "{at}:-60"},
    "one stamp ahead by 1 h": {"clock_steps": "{at}:3600,{after}:-3600"},
    "a fifth of the images lost": {"drop_share": 0.2},
    "images up to 100 ms late": {"jitter_ms": 100.0},
    "best effort, after the graph": {"reliability": "best_effort"},
}

RATES = (
    Column("name", "graph"),
    Column("camera_hz", "camera Hz", ".0f"),
    Column("poses_hz", "poses/s", ".1f"),
    Column("latency_ms_p50", "p50 ms", ".0f"),
    Column("latency_ms_p99", "p99 ms", ".0f"),
    Column("lost_percent", "lost %", ".1f"),
    Column("cpu_ms", "cpu ms/frame", ".1f"),
    Column("pss_mib", "MiB", ".0f"),
    Column("start_s", "start s", ".1f"),
    Column("out_of_order", "out of order", "d"),
)
FAULTS = (Column("fault", "fault"), Column("gap_s", "s without a pose", ".2f"), Column("said", "the entrance said"))


@dataclass(frozen=True)
class LiveBench:
    """What is measured on.

    Attributes:
        bag: the recording that the camera plays, with its CAD model.
        config: of all nodes.
        graph: ``processes`` (five) or ``single``.
        seconds: that are measured at each rate.
    """

    bag: Path
    config: HatConfig
    graph: str
    seconds: float

    def tables(self, rates_hz: list[float]) -> Iterator[tuple[str, Table]]:
        """Name and table, each as soon as it is measured; the faults at the first of the rates."""
        yield "live_rates", self.rates(rates_hz)
        yield "live_faults", self.faults(rates_hz[0])

    def rates(self, rates_hz: list[float]) -> Table:
        """A row for this process without a graph, and one for each rate of the camera."""
        rows = [self._in_process(), *(self._at_rate(rate_hz) for rate_hz in rates_hz)]
        return Table(f"{self.bag.name}, live, {self.seconds:g} s each", RATES, rows)

    def faults(self, rate_hz: float) -> Table:
        """A row for each fault, at one rate of the camera."""
        rows = self._kills(rate_hz) if self.graph == "processes" else []
        rows += [self._camera_fault(name, rate_hz, changes) for name, changes in _CAMERA_FAULTS.items()]
        return Table(f"{self.bag.name}, faults at {rate_hz:g} Hz", FAULTS, rows)

    @property
    def _target(self) -> Path:
        target = BagReader(self.bag).target_path
        if target is None:
            raise InputError(f"{self.bag} brings no CAD model: `hat import --model` puts one in")
        return target

    def _in_process(self) -> dict[str, Any]:
        """The method alone, frame by frame, with images that are decoded already."""
        frames = list(BagReader(self.bag, camera_config=self.config.camera).frames())
        tracker = HatTracker(self.config, load_target(self._target))
        for frame in frames[:10]:  # compiles
            tracker.step(frame)
        tracker.reset()
        laps_s, began_s, began_cpu_s = [], time.perf_counter(), time.process_time()
        for frame in frames:
            lap_s = time.perf_counter()
            tracker.step(frame)
            laps_s.append(time.perf_counter() - lap_s)
        p50, p99 = 1e3 * np.percentile(laps_s, [50, 99])
        return {
            "name": "in process",
            "poses_hz": len(frames) / (time.perf_counter() - began_s),
            "latency_ms_p50": float(p50),
            "latency_ms_p99": float(p99),
            "cpu_ms": 1e3 * (time.process_time() - began_cpu_s) / len(frames),
        }

    def _at_rate(self, rate_hz: float) -> dict[str, Any]:
        LOG.info("camera of %g Hz", rate_hz)
        with live_graph(self.config, self._target, self.graph) as live:
            start_s = self._begin(live, rate_hz)
            watched, before, since = live.watched, live.cost(), Moment()
            live.run(self.seconds)
            after, until = live.cost(), Moment()
        latency_ms = watched.latency_ms(since.steady_s, until.steady_s)
        if not len(latency_ms):
            raise RunError(f"no answer within {self.seconds:g} s; the nodes last said: {live.last_words()}")
        sent = round(1e-9 * (until.wall_ns - since.wall_ns) * rate_hz)
        cpu_s = sum(after.cpu_s.values()) - sum(before.cpu_s.values())
        p50, p99 = np.percentile(latency_ms, [50, 99])
        return {
            "name": self.graph,
            "camera_hz": rate_hz,
            "poses_hz": watched.n_poses(since.steady_s, until.steady_s) / (until.steady_s - since.steady_s),
            "latency_ms_p50": float(p50),
            "latency_ms_p99": float(p99),
            "lost_percent": max(0.0, 100 * (1 - len(latency_ms) / sent)),
            "cpu_ms": 1e3 * cpu_s / len(latency_ms),
            "pss_mib": sum(after.pss_mib.values()),
            "start_s": start_s,
            "out_of_order": watched.n_out_of_order(),
        }

    def _begin(self, live: LiveGraph, rate_hz: float, **camera: Any) -> float:
        """Start the graph, then its camera, and let it settle; seconds from the start to the first pose."""
        began = Moment()
        live.start()
        live.start_camera(self.bag, rate_hz=rate_hz, transport="raw", **camera)
        start_s = live.await_pose(began, _LIMIT_S)
        live.run(_SETTLE_S)
        return start_s

    def _kills(self, rate_hz: float) -> list[dict[str, Any]]:
        """Each stage is killed in turn, in one graph."""
        rows = []
        with live_graph(self.config, self._target, self.graph) as live:
            self._begin(live, rate_hz)
            for name in STAGES:
                LOG.info("kill -9 %s", name)
                since = live.kill(name)
                rows.append({"fault": f"kill -9 {name}", "gap_s": live.await_pose(since, _LIMIT_S)})
                rows[-1]["said"] = live.worst_words("segmentation", since)
                live.run(_AROUND_S)
        return rows

    def _camera_fault(self, name: str, rate_hz: float, changes: dict[str, Any]) -> dict[str, Any]:
        """The fault comes some time after the first image; the longest gap around it counts."""
        LOG.info("%s", name)
        with live_graph(self.config, self._target, self.graph) as live:
            self._begin(live, rate_hz)
            # A second camera, with the fault, takes the place of the first.
            live.processes.end("camera")
            at = {"at": f"{_AROUND_S:g}", "after": f"{_AROUND_S + 1 / rate_hz:.6f}"}
            texts = {key: value.format(**at) if isinstance(value, str) else value for key, value in changes.items()}
            replaced = Moment()
            live.start_camera(self.bag, "camera_with_fault", rate_hz=rate_hz, transport="raw", **texts)
            live.await_pose(replaced, _LIMIT_S)
            since = Moment()
            live.run(2 * _AROUND_S)
            gap_s = live.watched.longest_gap(since.steady_s, time.monotonic())
        said = live.worst_words("segmentation", since)
        return {"fault": name, "gap_s": gap_s, "said": said}
