"""Segments of dead processes are freed, those of living ones are not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hat_ros.ros.shared_memory import free_abandoned

HOLDER = """
import fcntl, sys, time
file = open(sys.argv[1])
fcntl.flock(file, fcntl.LOCK_EX)
print("held", flush=True)
time.sleep(600)
"""


def segment(folder: Path, digits: str, age_s: float = 60.0) -> Path:
    path = folder / f"fastrtps_{digits * 16}"
    path.write_bytes(bytes(100))
    lock = folder / f"{path.name}_el"
    lock.touch()
    os.utime(lock, (lock.stat().st_mtime - age_s,) * 2)
    return lock


def test_only_what_nobody_holds_is_removed(tmp_path):
    held, dead, young = segment(tmp_path, "a"), segment(tmp_path, "b"), segment(tmp_path, "c", age_s=0.0)
    others = [tmp_path / "fastrtps_port7411_el", tmp_path / "sem.other", tmp_path / "fastrtps_abc_el"]
    for other in others:
        other.touch()
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(held)], stdout=subprocess.PIPE)
    try:
        assert holder.stdout.readline() == b"held\n"
        assert free_abandoned(tmp_path) == 1
        assert not dead.exists()
        assert not (tmp_path / dead.name.removesuffix("_el")).exists()
        assert held.exists()
        assert young.exists()
        assert all(other.exists() for other in others)
    finally:
        holder.kill()
        holder.wait()
        holder.stdout.close()
    assert free_abandoned(tmp_path) == 1
    assert free_abandoned(tmp_path / "missing") == 0


PARTICIPANT = """
import sys, time, rclpy
from hat_ros.ros.environment import prepare_environment
prepare_environment()
rclpy.init(domain_id=116)
node = rclpy.create_node("x")
print("up", flush=True)
time.sleep(600)
"""


@pytest.mark.graph
def test_a_participant_that_lives_keeps_its_segment_and_a_killed_one_loses_it():
    shared = Path("/dev/shm")
    process = subprocess.Popen([sys.executable, "-c", PARTICIPANT], stdout=subprocess.PIPE)
    try:
        assert process.stdout.readline() == b"up\n"
        opened = Path(f"/proc/{process.pid}/fd")
        locks = [Path(os.readlink(fd)) for fd in opened.iterdir() if "fastrtps_" in os.readlink(fd)]
        locks = [lock for lock in locks if lock.name.endswith("_el") and "port" not in lock.name]
        assert len(locks) >= 1
        for lock in locks:
            os.utime(lock, (lock.stat().st_mtime - 60,) * 2)
        free_abandoned()
        assert all(lock.exists() for lock in locks)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
    free_abandoned()
    assert not [lock for lock in locks if lock.exists() or (shared / lock.name.removesuffix("_el")).exists()]
