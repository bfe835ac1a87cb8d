"""Many clips: in worker processes, resumable, failures kept apart.

Each clip's result is one file, ``clips/000017.json``, with a fingerprint of all that determines it. A file with the
same fingerprint is used again, so a campaign that was stopped goes on where it was.
"""

from __future__ import annotations

import json
import os
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2

from hat_ros.bench.campaign.crafts import Craft
from hat_ros.bench.campaign.draw import CampaignClip
from hat_ros.bench.campaign.play import film_clip, play_clip
from hat_ros.bench.campaign.score import figures_of, figures_of_failure, rounded
from hat_ros.bench.synth.clips import trajectory, write_clip
from hat_ros.bench.synth.mismatch import apply_mismatch
from hat_ros.config import HatConfig
from hat_ros.errors import RunError
from hat_ros.io.own_folder import MARKER, mark
from hat_ros.io.provenance import code_hash, config_hash
from hat_ros.io.results import write_json

CLIPS_FOLDER, KEPT_FOLDER = "clips", "kept"
# Figures that are infinite where they were never reached; null in a file.
NEVER = ("first_right", "first_tracking", "E_p_mean", "E_p_plain_mean")
# One thread per worker: timings are comparable, and N jobs use N cores.
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Task:
    """One clip to play.

    Attributes:
        clip: what it shows.
        craft: the craft that it names.
        config: of all stages.
        masks_given: frames bring their true silhouettes.
        out: folder of the campaign.
        keep: write the images as well.
    """

    clip: CampaignClip
    craft: Craft
    config: HatConfig
    masks_given: bool
    out: Path
    keep: bool = False

    @property
    def path(self) -> Path:
        """The file of its result."""
        return self.out / CLIPS_FOLDER / f"{self.clip.index:06d}.json"

    @property
    def kept(self) -> Path:
        """The folder of its images."""
        return self.out / KEPT_FOLDER / f"{self.clip.index:06d}"

    def fingerprint(self) -> dict[str, Any]:
        """All that determines the result."""
        return {
            "clip": json.loads(json.dumps(asdict(self.clip))),
            "craft_sha256": self.craft.sha256(),
            "config_sha256": config_hash(self.config),
            "code_sha256": code_hash(),
            "masks": "given" if self.masks_given else "own",
        }


@dataclass(frozen=True)
class Result:
    """What became of a clip.

    Attributes:
        index: its number.
        factors: what it showed, see :meth:`CampaignClip.factors`, and ``range_first_m``, null if it is not known.
        cell: its place on the map as in :class:`~hat_ros.bench.campaign.draw.Cell`, None = drawn freely.
        figures: see :func:`~hat_ros.bench.campaign.score.figures_of`.
        series: values frame by frame, null where there is none.
        failure: the sentence that says why it could not be played, empty where it could.
        reused: it was done before.
    """

    index: int
    factors: dict[str, Any]
    cell: dict[str, Any] | None
    figures: dict[str, Any]
    series: dict[str, list[Any]]
    failure: str = ""
    reused: bool = False


def run_clips(tasks: Sequence[Task], n_jobs: int, watch: Callable[[Result], None]) -> list[Result]:
    """Play what is not done yet, ``n_jobs`` clips at a time; a failure does not stop the others.

    Args:
        tasks: with clips of different numbers and one folder.
        n_jobs: worker processes.
        watch: called with each result as it comes.

    Returns:
        Results in the order of ``tasks``.

    Raises:
        RunError: the folder cannot be written, or a worker process was killed.
    """
    results: dict[int, Result] = {}
    todo = []
    for task in tasks:
        prints = task.fingerprint()
        done = _done(task, prints)
        if done is None:
            todo.append((task, prints))
        else:
            results[task.clip.index] = done
            watch(done)
    if todo:
        make_folder(todo[0][0].out)
        for result in _played(todo, n_jobs):
            results[result.index] = result
            watch(result)
    return [results[task.clip.index] for task in tasks]


def read_results(out: Path) -> list[Result]:
    """The results that lie in a campaign's folder, in order, whatever code made them.

    Raises:
        RunError: there are none, or one cannot be read.
    """
    paths = sorted((out / CLIPS_FOLDER).glob("[0-9]*.json"))
    if not paths:
        raise RunError(f"{out} holds no results of `hat campaign`: name the --out of a campaign")
    results = []
    for path in paths:
        try:
            results.append(_result(json.loads(path.read_text(encoding="utf-8"))))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RunError(f"{path} cannot be read ({error}): remove it and start the campaign again") from None
    return results


def _played(todo: Sequence[tuple[Task, dict[str, Any]]], n_jobs: int) -> Iterator[Result]:
    """Results as they come; when the caller stops, clips that are being played are finished and kept."""
    waiting = iter(todo)
    with _one_thread(), ProcessPoolExecutor(n_jobs, get_context("spawn"), _prepare_worker) as pool:
        try:
            # No clip is submitted before a worker is free: what waits in the pool could not be called off.
            playing = {pool.submit(play_task, *item) for item in islice(waiting, n_jobs)}
            while playing:
                done, playing = wait(playing, return_when=FIRST_COMPLETED)
                playing |= {pool.submit(play_task, *item) for item in islice(waiting, len(done))}
                for future in done:
                    yield future.result()
        except BrokenProcessPool:
            raise RunError(
                "campaign: a worker process was killed, perhaps for memory; what is done is kept: "
                "start the same command again, with fewer --jobs"
            ) from None


def play_task(task: Task, fingerprint: dict[str, Any]) -> Result:
    """Play a clip and write its file; whatever it raises is its failure."""
    series: dict[str, list[Any]] = {}
    factors = task.clip.factors() | {"range_first_m": None}
    failure = ""
    try:
        target = task.craft.load()
        factors["range_first_m"] = task.clip.spec(target.diameter_m).range_m[0]
        film = film_clip(task.clip, target)
        played = play_clip(film, target, task.config, task.masks_given)
        figures = figures_of(played)
        series = {name: rounded(values) for name, values in vars(played).items()}
        if task.keep:
            _keep(task)
    except Exception as error:  # of any kind: the campaign counts it and goes on
        failure = f"{type(error).__name__}: {' '.join(str(error).split())}"
        figures = figures_of_failure(task.clip.film.frames)
        task.path.with_suffix(".log").write_text(traceback.format_exc(), encoding="utf-8")
    cell = None if task.clip.cell is None else asdict(task.clip.cell)
    record = {
        "index": task.clip.index,
        "fingerprint": fingerprint,
        "factors": factors,
        "cell": cell,
        "figures": figures,
        "failure": failure,
        "series": series,
    }
    partial = task.path.with_suffix(".partial")
    write_json(partial, record)
    partial.replace(task.path)
    return _result(json.loads(task.path.read_text(encoding="utf-8")))


def _keep(task: Task) -> None:
    """Write the clip in the ``sequence`` layout, with its CAD model."""
    if task.kept.exists():
        return
    target = task.craft.load()
    spec = task.clip.spec(target.diameter_m)
    task.kept.parent.mkdir(parents=True, exist_ok=True)
    model = task.craft.model_file(task.kept.parent)
    seen = apply_mismatch(target, task.clip.mismatch)
    write_clip(seen, model.mesh, task.kept, spec, trajectory(spec, target), unit_scale=model.unit_scale)


def _done(task: Task, fingerprint: dict[str, Any]) -> Result | None:
    """The result of an earlier run with the same fingerprint; failures are tried again."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        record = json.loads(task.path.read_text(encoding="utf-8"))
        if record["fingerprint"] == fingerprint and not record["failure"] and (task.kept.exists() or not task.keep):
            return replace(_result(record), reused=True)
    return None


def _result(record: dict[str, Any]) -> Result:
    figures = dict(record["figures"])
    figures |= {key: float("inf") for key in NEVER if figures[key] is None}
    return Result(
        int(record["index"]), record["factors"], record["cell"], figures, record["series"], str(record["failure"])
    )


def make_folder(out: Path) -> None:
    """Make the folder of a campaign, or go on with the one that is there.

    Raises:
        RunError: it cannot be made.
    """
    try:
        (out / CLIPS_FOLDER).mkdir(parents=True, exist_ok=True)
        if not (out / MARKER).exists():
            mark(out)
    except OSError as error:
        raise RunError(f"cannot create {out}: {error.strerror}") from None


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that are started within use one thread each in the numerical libraries."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _prepare_worker() -> None:
    """One thread for OpenCV; Ctrl-C is the parent's affair, which waits for the clips that are being played."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
