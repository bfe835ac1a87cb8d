"""A node as a process of its own: exit codes, one sentence on stderr, a bag that is closed whatever ends it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader

from hat_ros.ros.domain import reserved_domain


def start(node, *parameters, domain):
    arguments = [part for parameter in parameters for part in ("-p", parameter)]
    return subprocess.Popen(
        [sys.executable, "-m", f"hat_ros.ros.{node}", "--ros-args", *arguments],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.graph
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_recorder_closes_its_bag(tmp_path, number):
    with reserved_domain(None) as domain:
        process = start("recorder_node", f"out:={tmp_path / 'out'}", domain=domain)
        for _ in range(600):
            if (tmp_path / "out" / "out.mcap").exists():
                break
            time.sleep(0.05)
        time.sleep(1.5)  # long enough for its own diagnostics
        process.send_signal(number)
        _, said = process.communicate(timeout=30)
    assert (process.returncode, said) == (0, "")
    with Reader(tmp_path / "out") as reader:
        assert reader.message_count >= 0


@pytest.mark.graph
def test_a_node_stopped_at_any_moment_ends_without_a_trace(tmp_path):
    with reserved_domain(None) as domain:
        processes = [start("recorder_node", f"out:={tmp_path / f'out{k}'}", domain=domain) for k in range(2)]
        for k, process in enumerate(processes):
            while not (tmp_path / f"out{k}").exists() and process.poll() is None:  # its start has begun
                time.sleep(0.01)
            time.sleep(0.15 * k)
            process.send_signal(signal.SIGTERM)
            process.send_signal(signal.SIGINT)
        ends = [(process.communicate(timeout=30)[1], process.returncode) for process in processes]
    assert ends == [("", 0)] * 2


@pytest.mark.graph
def test_bad_parameters_are_one_sentence_and_exit_code_two():
    with reserved_domain(None) as domain:
        process = start("selector_node", "selector.score_scal:=1.0", domain=domain)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 2
    assert said.strip().splitlines()[-1] == (
        "node selector: unknown parameter 'selector.score_scal': did you mean 'selector.score_scale'?"
    )
    assert "Traceback" not in said


ORPHAN = """
import subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", sys.argv[1]], stdout=subprocess.PIPE)
assert child.stdout.readline() == b"up\\n"
print(child.pid, flush=True)
time.sleep(600)
"""
CHILD = """
import time
from pathlib import Path
from hat_ros.ros.environment import end_with_parent
end_with_parent()
print("up", flush=True)
time.sleep(600)
"""


def test_a_process_that_is_to_end_with_its_parent_does():
    parent = subprocess.Popen([sys.executable, "-c", ORPHAN, CHILD], stdout=subprocess.PIPE)
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    end = time.monotonic() + 10
    while Path(f"/proc/{child}").exists() and time.monotonic() < end:
        state = Path(f"/proc/{child}/stat").read_text().rsplit(")", 1)[1].split()[0]
        if state == "Z":
            break
        time.sleep(0.05)
    assert time.monotonic() < end
