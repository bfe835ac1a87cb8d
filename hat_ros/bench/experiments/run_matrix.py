"""Many independent runs: each in a process of its own, resumable, failures kept apart.

A run is known by what determines its result: the recording's bytes, the configuration, the code, the mode and the
frame range. A finished run folder with the same fingerprint is used again, so an interrupted matrix goes on where it
stopped and its tables come out with the same bytes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from hat_ros.bench.source import SourceSpec
from hat_ros.config import HatConfig, load_config
from hat_ros.errors import RunError
from hat_ros.io.provenance import code_hash, config_hash, input_hash
from hat_ros.io.results import METRICS_FILE, RUN_FILE

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
# Backends that are networks.
_NETWORKS = ("mask2former", "megapose", "picopose", "gigapose", "droid")


GRAPH = "graph"


@dataclass(frozen=True)
class Job:
    """One run of ``hat track``.

    Attributes:
        name: unique within the matrix; the run's folder.
        spec: the recording.
        mode: method, or ``graph``: HAT through the five-node ROS graph.
        config: preset name or YAML file.
        overrides: ``key=value`` settings on top of it.
        start: frames skipped.
        limit: at most this many frames.
        labels: what the tables call it, column by column.
        poses: file of poses of a method that is not ours, which is then only scored; ``mode`` is its name.
    """

    name: str
    spec: SourceSpec
    mode: str = "hat"
    config: str = "default"
    overrides: tuple[str, ...] = ()
    start: int = 0
    limit: int | None = None
    labels: dict[str, str] = field(default_factory=dict)
    poses: Path | None = None

    def fingerprint(self) -> dict[str, Any]:
        """What ``run.json`` of this run must hold."""
        if self.poses is None:
            determined_by = {"config_sha256": config_hash(load_config(self.config, self.overrides))}
        else:
            determined_by = {"poses_sha256": input_hash(self.poses)}
        return {
            "source_sha256": _sha256(self.spec),
            **determined_by,
            "code_sha256": code_hash(),
            "mode": "hat" if self.mode == GRAPH else self.mode,
            "start": self.start,
            "limit": self.limit,
        }

    def threads(self, n_jobs: int) -> int:
        """Numerical threads of the run beside others: one, so that timings are comparable and N jobs use N cores.

        Networks share all cores among the jobs.
        """
        config = load_config(self.config, self.overrides) if self.poses is None else HatConfig()
        backends = (config.segmentation.backend, config.hypotheses.backend, config.slam.backend)
        return max(1, (os.cpu_count() or 1) // n_jobs) if set(backends) & set(_NETWORKS) else 1

    def command(self, folder: Path, threads: int = 1) -> list[str]:
        """The command line that makes ``folder``."""
        if self.poses is not None:
            how = ["score", "--method", self.mode, "--poses", str(self.poses)]
        elif self.mode == GRAPH:
            how = ["replay", "--config", self.config]
        else:
            how = ["track", "--mode", self.mode, "--config", self.config, "--threads", str(threads)]
            how += ["--credits", "1"] if self.spec.published else []
        command = [sys.executable, "-m", "hat_ros.cli", *how, str(self.spec.path), "--out", str(folder)]
        command += ["--start", str(self.start), "--no-video", "--no-report", "--quiet", "--overwrite"]
        if self.spec.dataset:
            command += ["--dataset", self.spec.dataset, "--sequence", self.spec.sequence]
            if self.spec.published:
                command += ["--protocol", "published"]
        if self.spec.model is not None:
            command += ["--model", str(self.spec.model)]
        if self.spec.detections is not None:
            command += ["--detections", str(self.spec.detections)]
        if self.limit is not None:
            command += ["--limit", str(self.limit)]
        for override in self.overrides:
            command += ["--set", override]
        return command


@dataclass(frozen=True)
class Outcome:
    """What became of a job: its figures, or the sentence that says why there are none."""

    job: Job
    folder: Path
    figures: dict[str, Any] | None
    failure: str = ""
    reused: bool = False


@cache
def _sha256(spec: SourceSpec) -> str:
    return spec.sha256()


def run_jobs(
    jobs: Sequence[Job],
    out: Path,
    n_jobs: int = 1,
    watch: Callable[[Outcome], None] | None = None,
) -> list[Outcome]:
    """Run what is not done yet, ``n_jobs`` at a time; one job's failure does not stop the others.

    Args:
        jobs: with unique names.
        out: folder of the runs; runs go to ``out/runs/<job name>``.
        n_jobs: processes at a time.
        watch: called with each outcome as it comes.

    Returns:
        Outcomes in the order of ``jobs``.

    Raises:
        ConfigError: a job's configuration is bad; nothing runs then.
        RunError: the folder of the runs cannot be written.
    """
    work = [(job, out / "runs" / job.name, job.fingerprint()) for job in jobs]
    runs = out / "runs"
    try:
        runs.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"cannot create {runs}: {error.strerror}") from None
    outcomes: dict[str, Outcome] = {}
    with ThreadPoolExecutor(n_jobs) as pool:
        try:
            for future in as_completed([pool.submit(run_job, *item, n_jobs) for item in work]):
                outcome = future.result()
                outcomes[outcome.job.name] = outcome
                if watch is not None:
                    watch(outcome)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [outcomes[job.name] for job in jobs]


def run_job(job: Job, folder: Path, fingerprint: dict[str, Any], n_jobs: int = 1) -> Outcome:
    """Run one job in a process of its own, beside others, unless a finished run with this fingerprint is there."""
    if (figures := _finished(folder, fingerprint)) is not None:
        return Outcome(job, folder, figures, reused=True)
    threads = job.threads(n_jobs)
    environment = os.environ | dict.fromkeys(_THREADS, str(threads))
    done = subprocess.run(job.command(folder, threads), capture_output=True, text=True, env=environment)
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        (folder.parent / f"{folder.name}.log").write_text(done.stderr, encoding="utf-8")
        return Outcome(job, folder, None, lines[-1])
    return Outcome(job, folder, json.loads((folder / METRICS_FILE).read_text(encoding="utf-8")))


def _finished(folder: Path, fingerprint: dict[str, Any]) -> dict[str, Any] | None:
    try:
        run = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
        figures = json.loads((folder / METRICS_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return figures if all(run.get(key) == value for key, value in fingerprint.items()) else None
