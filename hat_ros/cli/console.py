"""What people see while a command runs and when it has finished."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from hat_ros.types import TrackState

STATE_STYLE = {
    TrackState.UNINITIALISED: "dim",
    TrackState.TRACKING: "green",
    TrackState.COASTING: "yellow",
    TrackState.LOST: "red",
    TrackState.INITIALISING: "magenta",
}


@contextmanager
def log_shown(console: Console) -> Iterator[None]:
    """Log records of this package appear as lines above the bar."""
    log, handler = logging.getLogger("hat_ros"), RichHandler(console=console, show_level=False, show_path=False)
    before = log.level
    log.setLevel(logging.INFO)
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(before)


@contextmanager
def state_progress(title: str, quiet: bool) -> Iterator[Callable[[int, int, TrackState], None]]:
    """A bar with frames per second and state; yields what to call with (frames done, frames in all, newest state)."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[fps]:5.1f} fps"),
        TextColumn("{task.fields[state]}"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True, quiet=quiet)
    with log_shown(console), Progress(*columns, console=console, disable=quiet) as progress:
        task = progress.add_task(title, total=None, fps=0.0, state="")
        started: list[float] = []

        def watch(done: int, total: int, state: TrackState) -> None:
            now = time.perf_counter()
            if not started:
                started.append(now)
            fps = (done - 1) / (now - started[0]) if now > started[0] else 0.0
            shown = f"[{STATE_STYLE[state]}]{state.name}[/]"
            progress.update(task, completed=done, total=total, fps=fps, state=shown)

        yield watch


def print_figures(folder: Path) -> None:
    """The main figures of a result folder as a table on stdout."""
    figures = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    table = Table(title=str(folder), show_header=False)
    for label, text in figure_lines(figures):
        table.add_row(label, text)
    Console().print(table)


def print_refused(folder: Path) -> None:
    """Say on stderr which frames of a run were refused and why; nothing where none was."""
    figures = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    for reason in figures.get("refused_reasons", ()):
        print(f"hat: refused {reason['count']} of {figures['frames']} frames: {reason['first']}", file=sys.stderr)


def figure_lines(figures: dict[str, Any]) -> list[tuple[str, str]]:
    """Label and text of the figures that people ask for first."""

    def number(name: str, form: str = ".4f") -> str:
        value = figures.get(name)
        return "-" if value is None else format(value, form)

    lines = [
        ("frames", f"{figures['frames']} ({figures['valid']} with a pose, coverage {number('coverage', '.1%')})"),
        *[("refused", f"{reason['count']} x {reason['first']}") for reason in figures.get("refused_reasons", ())],
        *([("dropped", str(figures["dropped"]))] if figures.get("dropped") else []),
        ("pose error E_p", f"{number('E_p_mean')} (SD {number('E_p_sd')})"),
        *([("E_p to the nearest equal", number("E_p_sym_mean"))] if _is_symmetric(figures) else []),
        ("translation error E_t", f"{number('E_t_m_mean')} m (SD {number('E_t_m_sd')})"),
        ("rotation error E_q", f"{number('E_q_deg_mean', '.2f')} deg (SD {number('E_q_deg_sd', '.2f')})"),
        ("beyond 90 degrees", number("E_q_over_90_share", ".1%")),
    ]
    if figures.get("fps") is not None:
        latency = f"p50 {number('latency_ms_p50', '.1f')} ms, p99 {number('latency_ms_p99', '.1f')} ms"
        lines.append(("speed", f"{number('fps', '.1f')} frames/s, latency {latency}"))
    return lines


def _is_symmetric(figures: dict[str, Any]) -> bool:
    """Whether some poses of the target look alike."""
    return figures.get("symmetry_order", 1) > 1 or figures.get("symmetry_free_axes", 0) > 0


@contextmanager
def matrix_progress(total: int) -> Iterator[Callable[[Any], None]]:
    """A line per finished run and a bar over all of them; yields what to call with each outcome."""
    console = Console(stderr=True)
    columns = (TextColumn("runs"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("runs", total=total)

        def watch(outcome: Any) -> None:
            if outcome.figures is None:
                text = f"[red]failed[/]: {outcome.failure}"
            else:
                text = ", ".join(f"{label} {value}" for label, value in figure_lines(outcome.figures)[1:2])
                text += " (done before)" if outcome.reused else ""
            console.print(f"{outcome.job.name}: {text}", highlight=False)
            progress.advance(task)

        yield watch


@contextmanager
def count_progress(quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A bar per named item; yields what to call with (name, done, in all)."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet) as progress:
        tasks: dict[str, TaskID] = {}

        def watch(name: str, done: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = progress.add_task(name, total=total)
            progress.update(tasks[name], completed=done)

        yield watch
