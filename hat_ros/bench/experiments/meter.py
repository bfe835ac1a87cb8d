"""Counts and times what a tracker does, without changing its code.

Stages are measured through the wrapper that a tracker gives them; networks by torch's own hooks on module calls (the
outermost module counts, under the name of its class); other costly parts by their spans (:mod:`hat_ros.spans`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

if TYPE_CHECKING:
    from torch import nn

Stage = TypeVar("Stage")

# What a tracker does before its first frame: loading weights, rendering templates.
CONSTRUCTION = "construction"


@dataclass
class Tally:
    """Calls of one part, the images in them, and their wall time; sums, or means over frames."""

    calls: float = 0
    images: float = 0
    seconds: float = 0.0


class Meter:
    """Counts and times the stages of one tracker and the parts within them.

    Args:
        wait: called before each reading of the clock, so that work handed to a device is done.
    """

    def __init__(self, wait: Callable[[], None]) -> None:
        self._wait = wait
        self._tallies: dict[str, Tally] = {}
        self._parts: dict[str, list[str]] = {CONSTRUCTION: []}  # of each stage, as first seen
        self._stage = CONSTRUCTION
        self._open_modules: list[float] = []  # start of each network call that has not ended

    def wrap(self, name: str, stage: Stage) -> Stage:
        """The stage measured; a :data:`~hat_ros.tracker.StageWrapper`."""
        self._parts.setdefault(name, [])
        return cast("Stage", _MeteredStage(stage, name, self))

    def rows(self) -> list[tuple[str, str]]:
        """(name, name indented for tables) of every stage, each followed by its parts."""
        out: list[tuple[str, str]] = []
        for stage, parts in self._parts.items():
            out += [(stage, stage), *((part, f"  {part}") for part in parts)]
        return out

    def take(self) -> dict[str, Tally]:
        """Tallies by stage and part since the last call."""
        taken, self._tallies = self._tallies, {}
        return taken

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the update of a stage; parts within belong to it."""
        self._stage = name
        with self._timed(name, 1):
            yield

    @contextmanager
    def part(self, name: str, images: int) -> Iterator[None]:
        """Measure a part of the present stage; what :func:`hat_ros.spans.listening` calls."""
        self._note(name)
        with self._timed(name, images):
            yield

    @contextmanager
    def networks(self) -> Iterator[None]:
        """Within, measure every call of a network of any backend."""
        from torch.nn.modules.module import register_module_forward_hook, register_module_forward_pre_hook

        begin = register_module_forward_pre_hook(self._begin_module)
        end = register_module_forward_hook(self._end_module, always_call=True)
        try:
            yield
        finally:
            begin.remove()
            end.remove()

    def _begin_module(self, module: nn.Module, _: Any) -> None:
        if not _is_layer(module):
            self._open_modules.append(self._now() if not self._open_modules else 0.0)

    def _end_module(self, module: nn.Module, inputs: tuple[Any, ...], _: Any) -> None:
        if _is_layer(module):
            return
        start_s = self._open_modules.pop()
        if not self._open_modules:
            name = type(module).__name__.lstrip("_")
            self._note(name)
            self._add(name, _images(inputs), self._now() - start_s)

    @contextmanager
    def _timed(self, name: str, images: int) -> Iterator[None]:
        start_s = self._now()
        try:
            yield
        finally:
            self._add(name, images, self._now() - start_s)

    def _now(self) -> float:
        self._wait()
        return time.perf_counter()

    def _note(self, name: str) -> None:
        """Remember the stage of a part; what construction uses as well belongs to the stage."""
        if not any(name in parts for stage, parts in self._parts.items() if stage != CONSTRUCTION):
            if self._stage != CONSTRUCTION and name in self._parts[CONSTRUCTION]:
                self._parts[CONSTRUCTION].remove(name)
            if name not in self._parts[self._stage]:
                self._parts[self._stage].append(name)

    def _add(self, name: str, images: int, seconds: float) -> None:
        tally = self._tallies.setdefault(name, Tally())
        tally.calls, tally.images, tally.seconds = tally.calls + 1, tally.images + images, tally.seconds + seconds


class _MeteredStage:
    """A stage whose ``update`` is measured; everything else is the stage's own."""

    def __init__(self, stage: Any, name: str, meter: Meter) -> None:
        self._stage, self._name, self._meter = stage, name, meter

    def update(self, *arguments: Any) -> Any:
        with self._meter.stage(self._name):
            return self._stage.update(*arguments)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stage, name)


def _is_layer(module: nn.Module) -> bool:
    """Whether it is one of torch's own building blocks rather than a network."""
    return type(module).__module__.startswith("torch.")


def _images(arguments: Sequence[Any]) -> int:
    """Rows of the first argument, or of the first tensor in it; 1 for what is given by name."""
    first: Any = arguments[0] if arguments else None
    first = first[0] if isinstance(first, (list, tuple)) and first else first
    return len(first) if hasattr(first, "shape") else 1
