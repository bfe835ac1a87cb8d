"""A ROS domain of one's own, so that runs side by side never hear each other."""

from __future__ import annotations

import contextlib
import fcntl
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

from hat_ros.errors import RunError

# Beyond 101 the RTPS ports reach into Linux's ephemeral range.
_DOMAINS = range(1, 102)


@contextlib.contextmanager
def reserved_domain(given: int | None) -> Iterator[int]:
    """A ROS domain that no other process uses, reserved while the context lasts."""
    if given is not None:
        yield given
        return
    for domain in _DOMAINS:
        path = Path(tempfile.gettempdir()) / f"hat_ros_domain_{domain}.lock"
        with contextlib.ExitStack() as stack:
            try:
                lock = stack.enter_context(path.open("a"))
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            if _in_use(domain):
                continue
            yield domain
            return
    raise RunError(f"no free ROS domain among {_DOMAINS.start} to {_DOMAINS.stop - 1}: end other ROS processes")


def _in_use(domain: int) -> bool:
    """Whether some participant listens on the domain's discovery port (RTPS: 7400 + 250 x domain)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", 7400 + 250 * domain))
        except OSError:
            return True
    return False
