"""How the end of a node process reads: what it was, and what to do."""

from __future__ import annotations

import os
import time

import pytest

from hat_ros.errors import InputError, RunError, StageTimeoutError
from hat_ros.ros.stage_processes import StageProcesses
from hat_ros.ros.timeouts import HANGS


@pytest.mark.parametrize(
    ("code", "log", "kind", "sentence"),
    [
        (2, "noise\nbad preset\n\n", InputError, "bad preset"),
        (1, f"no status for frame 7: {HANGS}\n", StageTimeoutError, "no status for frame 7: stage 'slam' is behind"),
        (1, "broke\n", RunError, "node 'slam' ended with exit code 1 after 3 frames: broke"),
        (-9, "", RunError, "node 'slam' was killed by SIGKILL after 3 frames: it left no message"),
    ],
)
def test_the_cause_is_one_sentence(tmp_path, code, log, kind, sentence):
    (tmp_path / "slam.log").write_text(log)
    error = StageProcesses(tmp_path, 7).cause_of_end("slam", code, 3, "stage 'slam' is behind")
    assert type(error) is kind
    assert str(error) == sentence


@pytest.mark.graph
def test_processes_are_watched_and_ended(tmp_path):
    processes = StageProcesses(tmp_path, 114)
    try:
        processes.start("single", {"config": "default", "autostart": False}, {"slam": 5.0})
        assert "debug_stage_delay_ms: 5.0" in (tmp_path / "parameters.yaml").read_text()
        assert f"supervisor_pid: {os.getpid()}" in (tmp_path / "parameters.yaml").read_text()
        assert processes.running
        assert processes.ended() is None
        processes.note_memory()
        assert processes.peak_memory_mib > 0
    finally:
        processes.close()
    assert not processes.running
    assert processes.ended()[0] == "graph"
    processes.close()


@pytest.mark.graph
def test_one_that_failed_is_found(tmp_path):
    processes = StageProcesses(tmp_path, 114)
    try:
        processes.start("single", {"config": "nonsense"}, {})
        end = time.monotonic() + 60
        while processes.ended() is None and time.monotonic() < end:
            time.sleep(0.1)
        name, code = processes.ended()
        assert (name, code) == ("graph", 2)
        assert "nonsense" in str(processes.cause_of_end(name, code, 0, ""))
    finally:
        processes.close()
