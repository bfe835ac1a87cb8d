"""What every run has in common: which frames it takes, what it writes, and the result folder around it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hat_ros.bench.evaluation.result_folder import complete_folder
from hat_ros.bench.source import SourceSpec
from hat_ros.config import HatConfig
from hat_ros.core.refusals import Refusals
from hat_ros.errors import HatError, RunError
from hat_ros.io.provenance import describe_run
from hat_ros.io.results import CONFIG_FILE, RUN_FILE, ResultFolder, write_config, write_json
from hat_ros.types import TrackState

Watcher = Callable[[int, int, TrackState], None]
"""Called with frames done, frames in all and the newest state."""


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Which frames a run takes, and what it writes beside its results.

    Attributes:
        start: frames skipped at the beginning (a cold start later in the clip).
        limit: at most this many frames, None = all.
        video: write the overlay video.
        report: write ``report.html``.
        overwrite: replace a finished result folder.
    """

    start: int = 0
    limit: int | None = None
    video: bool = True
    report: bool = True
    overwrite: bool = False


def record_frames(folder: Path, played: int, refusals: Refusals) -> None:
    """Put into ``run.json`` how many frames the run was given, and which of them were refused."""
    run = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
    counts = {"played": played, "refused": refusals.total, "refused_reasons": refusals.records()}
    write_json(folder / RUN_FILE, run | counts)


def no_frame_used(path: Path, refusals: Refusals) -> str:
    """The sentence about a recording of which every frame was refused."""
    return f"no frame of {path} could be used, {refusals.total} were refused: {refusals}"


@contextmanager
def result_folder(folder: ResultFolder, spec: SourceSpec, config: HatConfig | None, **how: Any) -> Iterator[Path]:
    """A result folder around a run; one that stops leaves tables and metrics of what was done in ``*.partial``.

    Args:
        folder: where to, not yet entered.
        spec: the recording.
        config: of all stages; None for a method that has none of ours.
        how: more for ``run.json``.

    Yields:
        The folder under construction, with ``config.yaml`` and ``run.json`` in it.

    Raises:
        RunError: the run stopped half-way; the sentence names what is left.
    """
    with folder:
        run = describe_run(spec.path, spec.sha256(), config or HatConfig(), **spec.describe(), **how)
        if config is None:
            (folder.path / CONFIG_FILE).write_text(f"# {how['mode']}: poses of an external method\n", encoding="utf-8")
            run["config_sha256"] = None
        else:
            write_config(folder.path, config)
        write_json(folder.path / RUN_FILE, run)
        try:
            yield folder.path
        except BaseException as error:
            with suppress(HatError, OSError):
                complete_folder(folder.path, None, {}, video=False, report=False)
            if isinstance(error, OSError):
                reason = error.strerror or type(error).__name__
                raise RunError(f"the run stopped ({reason}); what was done is in {folder.path}") from None
            if isinstance(error, RunError):
                raise type(error)(f"{error}; what was done is in {folder.path}") from None
            raise
