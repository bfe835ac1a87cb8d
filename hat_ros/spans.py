"""Spans: named stretches of costly work that can be counted and timed from outside; free while nothing listens.

with span("renders", len(poses)):
    ...
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

Listener = Callable[[str, int], AbstractContextManager[None]]
"""Given the name of a span and how many items it works on, what is entered around it."""

_UNMEASURED: AbstractContextManager[None] = nullcontext()
_listeners: list[Listener] = []


def span(name: str, count: int = 1) -> AbstractContextManager[None]:
    """A context around a stretch of work on ``count`` items."""
    return _listeners[-1](name, count) if _listeners else _UNMEASURED


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Within, every span of this process is entered through the listener."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)
