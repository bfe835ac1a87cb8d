"""What must be settled before the first DDS participant exists: profile, discovery, allocator, threads."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import cv2

from hat_ros.config import preset_folder

PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
OPENCV_THREADS = "OPENCV_FOR_THREADS_NUM"

# Eight processes with the segment of fastdds.xml; containers often have 64 MiB in all.
_AMPLE_SHARED_BYTES = 8 * 64 * 2**20
# prctl.h, malloc.h
_PR_SET_PDEATHSIG = 1
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def profile_path(shared_memory: Path = Path("/dev/shm")) -> Path | None:
    """The Fast DDS profile shipped with the package, chosen by the free shared memory; None if it is missing."""
    name = "fastdds.xml" if _free_bytes(shared_memory) >= _AMPLE_SHARED_BYTES else "fastdds_small.xml"
    path = preset_folder() / name
    return path if path.is_file() else None


def _free_bytes(folder: Path) -> int:
    try:
        space = os.statvfs(folder)
    except OSError:
        return 0
    return space.f_bavail * space.f_frsize


def keep_large_blocks() -> None:
    """Let the allocator keep freed image buffers instead of handing each back to the kernel.

    glibc maps every block beyond 128 KiB afresh, and the page faults of a camera frame then cost more than copying it:
    1.4 ms instead of 0.1 ms to serialize 640 x 480 rgba8 (measured). Other C libraries are left as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, 32 * 2**20)
        mallopt(_M_TRIM_THRESHOLD, 256 * 2**20)


def end_with_parent() -> None:
    """Let the kernel send SIGTERM when the parent is gone, also in the middle of something long; Linux only."""
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is not None:
        prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM))


def leave_cores_to_stages() -> None:
    """One thread for OpenCV, unless the environment sets the number: stages and frames in flight are the threads.

    On two cores five nodes with a pool of OpenCV's in each were 7 % slower (measured on a clip before the Earth).
    """
    if OPENCV_THREADS not in os.environ:
        cv2.setNumThreads(1)


def prepare_environment() -> None:
    """Our Fast DDS profile for this process, unless the user has set one."""
    profile = profile_path()
    if profile is not None:
        os.environ.setdefault(PROFILE, str(profile))


@contextlib.contextmanager
def replay_environment() -> Iterator[None]:
    """For a graph of this process alone: our profile, and discovery on this machine only, unless the user set them.

    What the process does afterwards, and what it starts then, finds the environment as it was.
    """
    before = {name: os.environ.get(name) for name in (PROFILE, RANGE)}
    prepare_environment()
    os.environ.setdefault(RANGE, "LOCALHOST")
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
