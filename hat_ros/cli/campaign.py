"""``hat campaign``: random clips of any craft, and what share of them is found."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hat_ros.cli.options import Commands, add_config, natural, positive

if TYPE_CHECKING:
    from hat_ros.bench.campaign.run import Result, Task

_DEFAULT_GENERATED = 12
_EXAMPLES = """\
columns:
  found            clips whose mean E_p is below 0.1 with a pose on 90 % of the frames
  frames to right  median over all clips of the frames until a pose with E_p below 0.05; never = most have none
  TRACKING wrong   share of the frames called TRACKING whose E_p is above 0.1; far: above 0.6 or beyond 30 degrees
  right TRACKING   share of the frames with E_p below 0.05 that are called TRACKING
  best of 10       keyframes where the best of ten hypotheses is within 15 degrees
  in 95 %          TRACKING frames whose truth lies inside the stated 95 % ellipsoid
  cpu ms           processor time per frame: of segmentation (mean, 99th percentile), of all stages
  symmetric craft  E_p and angles are to the nearest of the orientations that look alike
  IoU              overlap of mask and true silhouette, 0 for a missing mask, where the craft spans 30 px
  in brackets      95 % intervals: Wilson for clips, bootstrap over clips for the others
examples:
  hat campaign --out out/campaign                                   generated craft, 48 clips
  hat campaign my.glb --map --out out/map                           where it will work: size x phase x background
  hat campaign my.glb --masks given --out out/given                 the same clips, told the true masks
  hat campaign --compare out/campaign out/given                     what was won and lost, clip by clip
"""


def add_commands(commands: Commands) -> None:
    """Register this group."""
    parser = commands.add_parser(
        "campaign",
        help="random clips of your CAD model: what share is found, and where it will work",
        description="Render random clips over craft, light, range, rate, background, sensor and CAD mismatch, track\n"
        "them, and write tables with confidence intervals, figures and a report. Clips are drawn by seed and number;\n"
        "those that are done already, with the same inputs, configuration and code, are used again.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("cad", nargs="*", type=Path, metavar="CAD", help="CAD files in metres, or target.yaml files")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the campaign; resumed if it exists")
    parser.add_argument(
        "--generated",
        type=natural,
        metavar="N",
        help=f"N generated craft beside the CAD files (default: {_DEFAULT_GENERATED} where no CAD file is named)",
    )
    parser.add_argument("--clips", type=positive, metavar="N", help="clips (default: 48; with --map 3 for each place)")
    parser.add_argument("--seed", type=natural, default=1, help="of everything that is drawn (default: 1)")
    parser.add_argument("--frames", type=positive, default=50, metavar="N", help="frames per clip (default: 50)")
    parser.add_argument(
        "--size", type=positive, nargs=2, default=(640, 480), metavar=("W", "H"), help="image, px (default: 640 480)"
    )
    parser.add_argument("--focal", type=float, default=1000.0, metavar="PX", help="focal length, px (default: 1000)")
    parser.add_argument(
        "--masks",
        choices=("own", "given"),
        default="own",
        help="own: the preset's segmentation; given: the true silhouettes, which tells the stages apart (default: own)",
    )
    parser.add_argument(
        "--map", action="store_true", help="clips spread evenly over size, phase angle and background: where it works"
    )
    add_config(parser)
    parser.add_argument("--jobs", type=positive, default=1, metavar="N", help="clips at a time (default: 1)")
    parser.add_argument(
        "--keep-clips", action="store_true", help="write the images too, in DIR/kept, for `hat track` and for a look"
    )
    parser.add_argument(
        "--report-only", action="store_true", help="run nothing: tables and figures of what lies in --out"
    )
    parser.add_argument(
        "--compare", nargs=2, type=Path, metavar=("A", "B"), help="run nothing: two campaigns over the same clips"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(command=_campaign)


def _campaign(arguments: argparse.Namespace) -> int:
    from hat_ros.bench.campaign.compare import compare
    from hat_ros.bench.campaign.folder import write_folder
    from hat_ros.bench.campaign.run import read_results, run_clips
    from hat_ros.errors import UsageError
    from hat_ros.io.own_folder import checked_out

    if arguments.compare is not None:
        before, after = (read_results(folder) for folder in arguments.compare)
        print(compare(before, after).text(), end="")
        return 0
    if arguments.out is None:
        raise UsageError("campaign: --out is missing; it names the folder of the campaign")
    out = checked_out(arguments.out).resolve()
    if arguments.report_only:
        print(write_folder(out, read_results(out)), end="")
        return 0
    tasks = _tasks(arguments, out)
    _describe(arguments, tasks, out)
    with _progress(len(tasks), arguments.quiet) as watch:
        results = run_clips(tasks, arguments.jobs, watch)
    print(write_folder(out, results), end="")
    failed = [f"clip {result.index:06d}: {result.failure}" for result in results if result.failure]
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return 1 if failed else 0


def _tasks(arguments: argparse.Namespace, out: Path) -> list[Task]:
    """The clips that the arguments ask for."""
    from hat_ros.bench.campaign.crafts import crafts_named
    from hat_ros.bench.campaign.draw import View, draw_clip
    from hat_ros.bench.campaign.map import CLIPS_PER_CELL, map_cells
    from hat_ros.bench.campaign.run import Task
    from hat_ros.bench.experiments.comparison import GIVEN_MASKS
    from hat_ros.config import load_config
    from hat_ros.errors import UsageError

    given = arguments.masks == "given"
    config = load_config(arguments.config, [*arguments.overrides, *(GIVEN_MASKS if given else ())])
    generated = arguments.generated
    if generated is None:
        generated = 0 if arguments.cad else _DEFAULT_GENERATED
    if not arguments.focal > 0:
        raise UsageError(f"campaign: --focal must be positive, found {arguments.focal}")
    crafts = {craft.name: craft for craft in crafts_named(arguments.cad, generated)}
    cells = map_cells() if arguments.map else [None]
    count = arguments.clips or (CLIPS_PER_CELL * len(cells) if arguments.map else 48)
    width, height = arguments.size
    view = View(arguments.frames, width, height, arguments.focal)
    drawn = [draw_clip(arguments.seed, index, tuple(crafts), view, cells[index % len(cells)]) for index in range(count)]
    return [Task(clip, crafts[clip.craft], config, given, out, arguments.keep_clips) for clip in drawn]


def _describe(arguments: argparse.Namespace, tasks: Sequence[Task], out: Path) -> None:
    """Write ``run.json``: what the campaign was told, and the code that runs it."""
    from hat_ros.bench.campaign.run import make_folder
    from hat_ros.io.provenance import code_hash, code_version, config_hash
    from hat_ros.io.results import RUN_FILE, write_json

    make_folder(out)
    told = {
        "command": ["hat", *sys.argv[1:]],
        "seed": arguments.seed,
        "clips": len(tasks),
        "frames": arguments.frames,
        "size": list(arguments.size),
        "focal_px": arguments.focal,
        "masks": arguments.masks,
        "map": arguments.map,
        "crafts": {task.craft.name: task.craft.sha256() for task in tasks},
        "config": arguments.config,
        "overrides": arguments.overrides,
        "config_sha256": config_hash(tasks[0].config),
        "code": code_version(),
        "code_sha256": code_hash(),
    }
    write_json(out / RUN_FILE, told)


@contextmanager
def _progress(total: int, quiet: bool) -> Iterator[Callable[[Result], None]]:
    """A line per clip and a bar over all; yields what to call with each result."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from hat_ros.bench.campaign.report import described

    console = Console(stderr=True, quiet=quiet)
    columns: tuple[Any, ...] = (TextColumn("clips"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=quiet) as progress:
        task, found, done = progress.add_task("clips", total=total), 0, 0

        def watch(result: Result) -> None:
            nonlocal found, done
            found, done = found + bool(result.figures["found"]), done + 1
            outcome = result.failure or ("found" if result.figures["found"] else "lost")
            before = " (done before)" if result.reused else ""
            text = f"{described(result)}: {outcome}, E_p {result.figures['E_p_mean']:.3f}{before}, {found}/{done} found"
            console.print(text, highlight=False, markup=False, soft_wrap=True)
            progress.advance(task)

        yield watch
