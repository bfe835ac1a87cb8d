"""The node processes of a replay or of the live bench: started with their parameters, watched, and ended."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import yaml

from hat_ros.errors import ConfigError, HatError, InputError, RunError, StageTimeoutError
from hat_ros.ros.endpoints import PREFIX
from hat_ros.ros.timeouts import HANGS

STAGES = ("segmentation", "hypotheses", "slam", "selector", "fusion")


class StageProcesses:
    """Five processes, or one that holds all stages.

    Args:
        folder: for the parameter file and one log per process.
        domain: ROS domain.
    """

    def __init__(self, folder: Path, domain: int) -> None:
        self._folder, self._domain = folder, domain
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._started: dict[str, tuple[str, Path]] = {}
        self._logs: list[IO[bytes]] = []
        self._peak_mib: dict[str, float] = {}
        self._next_look_s = 0.0

    def start(self, graph: str, parameters: dict[str, Any], delays_ms: Mapping[str, float]) -> None:
        """Start the stages.

        Args:
            graph: ``processes`` or ``single``.
            parameters: of every node.
            delays_ms: stage -> largest random extra time per frame.

        Raises:
            ConfigError: an unknown stage.
        """
        for name in delays_ms:
            if name not in STAGES:
                raise ConfigError(f"stage_delays_ms: unknown stage '{name}', known are {', '.join(STAGES)}")
        file = self._folder / "parameters.yaml"
        supervised = {**parameters, "exit_at_end": True, "supervisor_pid": os.getpid()}
        content: dict[str, Any] = {"/**": {"ros__parameters": supervised}}
        for name, delay_ms in delays_ms.items():
            content[f"/{PREFIX}{name}"] = {"ros__parameters": {"graph": {"debug_stage_delay_ms": float(delay_ms)}}}
        file.write_text(yaml.safe_dump(content), encoding="utf-8")
        modules = {name: f"{name}_node" for name in STAGES} if graph == "processes" else {"graph": "single"}
        for name, module in modules.items():
            self._start(name, module, file)

    def add(self, name: str, module: str, parameters: dict[str, Any]) -> None:
        """Start one more process beside the stages, such as a camera."""
        file = self._folder / f"{name}.yaml"
        content = {"/**": {"ros__parameters": {**parameters, "supervisor_pid": os.getpid()}}}
        file.write_text(yaml.safe_dump(content), encoding="utf-8")
        self._start(name, module, file)

    def revive(self) -> list[str]:
        """Start again what has died, as the launch file does: neither what ended well nor what was given bad input."""
        ended = {name: process.poll() for name, process in self._processes.items()}
        died = [name for name, code in ended.items() if code not in (None, 0, InputError.exit_code)]
        for name in died:
            self._start(name, *self._started[name])
        return died

    def end(self, name: str) -> None:
        """End one process for good."""
        process = self._processes.pop(name)
        process.terminate()
        process.wait()

    def pid(self, name: str) -> int:
        """Process id of a process that was started."""
        return self._processes[name].pid

    def _start(self, name: str, module: str, parameters: Path) -> None:
        log = (self._folder / f"{name}.log").open("ab")
        self._logs.append(log)
        self._started[name] = (module, parameters)
        self._processes[name] = subprocess.Popen(
            [sys.executable, "-m", f"hat_ros.ros.{module}", "--ros-args", "--params-file", str(parameters)]
            + ["--disable-external-lib-logs"],
            env={**os.environ, "ROS_DOMAIN_ID": str(self._domain)},
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C is for us: the nodes are ended after what they sent is recorded
        )

    @property
    def running(self) -> bool:
        """Whether any of them still runs."""
        return any(process.poll() is None for process in self._processes.values())

    @property
    def peak_memory_mib(self) -> float:
        """Sum of the peak resident memory of each, in MiB."""
        return sum(self._peak_mib.values())

    def ended(self) -> tuple[str, int] | None:
        """Name and exit code of a process that has ended, one that failed before one that has not."""
        codes = [(name, code) for name, process in self._processes.items() if (code := process.poll()) is not None]
        return next((item for item in codes if item[1] != 0), codes[0] if codes else None)

    def cause_of_end(self, name: str, code: int, answered: int, culprit: str) -> HatError:
        """Why a process ended, as one sentence.

        Args:
            name: of the process.
            code: its exit code.
            answered: frames that had been answered.
            culprit: the stage that is behind, for a process that ended because a stage did not answer.
        """
        lines = (self._folder / f"{name}.log").read_text(encoding="utf-8", errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "it left no message")
        if code == InputError.exit_code:
            return InputError(last)
        if last.endswith(HANGS):
            return StageTimeoutError(f"{last.removesuffix(HANGS)}{culprit}")
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return RunError(f"node '{name}' {how} after {answered} frames: {last}")

    def note_memory(self) -> None:
        """Read the peak memory of each process, at most twice a second."""
        if time.monotonic() < self._next_look_s:
            return
        self._next_look_s = time.monotonic() + 0.5
        for name, process in self._processes.items():
            with contextlib.suppress(OSError, ValueError, StopIteration):
                status = Path(f"/proc/{process.pid}/status").read_text(encoding="ascii")
                line = next(line for line in status.splitlines() if line.startswith("VmHWM:"))
                self._peak_mib[name] = int(line.split()[1]) / 1024

    def close(self) -> None:
        """End those that still run: asked first, killed after three seconds; harmless when none is left."""
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
