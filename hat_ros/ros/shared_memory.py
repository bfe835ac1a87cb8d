"""Shared memory that killed processes have left behind: tens of MiB each, which the middleware does not free.

A Fast DDS participant holds a lock on ``NAME_el`` as long as it lives, beside its segment ``NAME``. So a lock that can
be taken belongs to a dead one; ``fastdds shm clean`` judges by the same sign.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import time
from pathlib import Path

_LOCK = re.compile(r"(fastrtps_[0-9a-f]{16})_el")
# A process that is just starting makes the file a moment before it takes the lock.
_YOUNG_S = 5.0


def free_abandoned(folder: Path = Path("/dev/shm")) -> int:
    """Remove the segments of this user's dead participants; how many there were. What cannot be removed stays."""
    freed = 0
    with contextlib.suppress(OSError):
        for path in sorted(folder.iterdir()):
            named = _LOCK.fullmatch(path.name)
            if named is not None and _is_abandoned(path):
                for name in (named[1], path.name):
                    with contextlib.suppress(OSError):
                        (folder / name).unlink()
                freed += 1
    return freed


def _is_abandoned(lock: Path) -> bool:
    try:
        state = lock.lstat()
        if state.st_uid != os.getuid() or time.time() - state.st_mtime < _YOUNG_S:
            return False
        with lock.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
