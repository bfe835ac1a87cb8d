"""``hat bench`` and ``hat ablate``: tables over many runs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from hat_ros.bench.methods.modes import MODES
from hat_ros.cli.options import (
    Commands,
    add_camera,
    add_config,
    add_dataset,
    add_protocol,
    natural,
    positive,
    protocol_settings,
)

if TYPE_CHECKING:
    from hat_ros.bench.experiments.comparison import Clip


def add_commands(commands: Commands) -> None:
    """Register this group."""
    _add_bench(commands)
    _add_ablate(commands)


def _add_run_matrix(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings",
        nargs="*",
        metavar="SEQ",
        help="bag or sequence folder, * allowed; SEQ@key=value[,key=value] gives these clips settings of their own",
    )
    add_dataset(parser, "run over the sequences")
    add_protocol(parser, "published")
    parser.add_argument("--root", type=Path, metavar="DIR", help="root folder of the --dataset; no bags are written")
    parser.add_argument(
        "--sequence",
        action="append",
        default=[],
        metavar="NAME",
        help="only this sequence of the data set (repeatable)",
    )
    parser.add_argument(
        "--suite", type=Path, metavar="DIR", help="all clips that `hat synth suite --out DIR` wrote, with its settings"
    )
    parser.add_argument(
        "--out", required=True, type=Path, metavar="DIR", help="folder of the runs; resumed if it exists"
    )
    add_config(parser)
    add_camera(parser)
    parser.add_argument("--limit", type=positive, metavar="N", help="at most N frames per run")
    parser.add_argument("--jobs", type=positive, default=1, metavar="N", help="runs at a time (default: 1)")


def _clips(arguments: argparse.Namespace) -> list[Clip]:
    """The recordings that the arguments name."""
    from hat_ros.bench.experiments.comparison import clips_named, clips_of_dataset, clips_of_suite
    from hat_ros.errors import UsageError

    if bool(arguments.dataset) != (arguments.root is not None):
        raise UsageError("--dataset and --root belong together: name the layout and the folder of the data set")
    if arguments.detections is not None and not arguments.dataset:
        raise UsageError("--detections belong to the --dataset; import a clip with its own (`hat import --detections`)")
    clips = clips_named(arguments.recordings)
    if arguments.suite is not None:
        clips += clips_of_suite(arguments.suite)
    if arguments.dataset:
        clips += clips_of_dataset(
            arguments.dataset,
            arguments.root,
            arguments.model,
            arguments.sequence,
            arguments.detections,
            published=arguments.protocol == "published",
        )
    if not clips:
        raise UsageError("nothing to run: name bags or sequence folders, a --suite, or a --dataset and its --root")
    return clips


def _names(*known: str) -> Callable[[str], list[str]]:
    def parse(text: str) -> list[str]:
        names = [name.strip() for name in text.split(",") if name.strip()]
        wrong = [name for name in names if name not in known]
        if wrong or not names:
            raise argparse.ArgumentTypeError(f"choose from {', '.join(known)}, separated by commas; found '{text}'")
        return list(dict.fromkeys(names))

    return parse


def _method_file(text: str) -> tuple[str, str]:
    name, separator, pattern = text.partition("=")
    if not name or not separator or not pattern or "/" in name:
        raise argparse.ArgumentTypeError(f"expected NAME=FILE, found '{text}'")
    return name, pattern


def _numbers(text: str) -> list[int]:
    return list(dict.fromkeys(natural(item) for item in text.split(",")))


_BENCH_COLUMNS = """\
columns:
  E_p, E_t, E_q, SD   pose, translation and rotation error: mean and sample standard deviation over scored frames
  >90                 share of scored frames more than 90 degrees off
  E_p sym             E_p to the nearest of the orientations that look alike; the same as E_p without a symmetry
  MSSD, MSPD          largest distance of a vertex from the nearest such truth, in metres and in pixels (BOP)
  cover               share of frames with ground truth that got a pose
  best<15, best<30    keyframes where the best of the K candidates is within 15 and 30 degrees
  IoU, IoU>.9         overlap of detected and recorded mask: mean, share of frames at 0.9 or better
  rel deg             median rotation error of the motion estimate from frame to frame
  false TRACKING      share of the frames more than 30 degrees off that are called TRACKING
  in 95%              share of frames whose ground truth lies inside the stated 95 % ellipsoid
  fps, p50, p99       frames per second with decoding, latency without; the first ten frames are left out
  fps w/o detector    the same without Stage 1, as published; only where frames ran one after another, as they do under
                      --protocol published
  cpu ms              processor time per frame without decoding
  MiB, +MiB           peak memory, and its growth from the first to the last quarter of the run
  run                 result folder of the run, below --out
"""


def _add_bench(commands: Commands) -> None:
    parser = commands.add_parser(
        "bench",
        help="clips x methods x masks x starts in one table",
        description="Run methods over clips, each run in a process of its own with one numerical thread, and write\n"
        "one table as text, CSV, LaTeX and JSON, and its figure as PNG and SVG. Runs that are done already,\n"
        "with the same inputs, configuration and code, are used again.",
        epilog=_BENCH_COLUMNS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_run_matrix(parser)
    parser.add_argument(
        "--modes",
        type=_names(*MODES, "graph"),
        metavar="LIST",
        help=f"methods, from {','.join(MODES)} and graph (bags through ROS) (default: hat,independent, unless there is "
        "a --method)",
    )
    parser.add_argument(
        "--method",
        dest="methods",
        action="append",
        default=[],
        metavar="NAME=MODE[:CONFIG][,KEY=VALUE]",
        help="a method under a name and with a configuration of its own, e.g. Mega-HAT=hat:mega_hat or "
        "MegaPose=independent:mega_hat (repeatable)",
    )
    parser.add_argument(
        "--masks",
        type=_names("own", "given"),
        default=["own"],
        metavar="LIST",
        help="own: the preset's segmentation; given: the recording's masks (default: own)",
    )
    parser.add_argument(
        "--start",
        type=_numbers,
        default=[0],
        metavar="LIST",
        help="cold starts at these frames, e.g. 0,60,120 (default: 0)",
    )
    parser.add_argument(
        "--poses",
        type=_method_file,
        action="append",
        default=[],
        metavar="NAME=FILE",
        help="a row for a method outside this package, from its file of poses (see `hat score`); {clip} in FILE stands "
        "for the clip's name (repeatable)",
    )
    parser.add_argument(
        "--live",
        action="store_true",
        help="instead: the live graph on one bag, with a camera that does not wait; rates, latencies, cost, faults",
    )
    parser.add_argument(
        "--rates", type=_numbers, default=[30, 60, 120], metavar="LIST", help="--live: Hz (default: 30,60,120)"
    )
    parser.add_argument(
        "--seconds", type=positive, default=20, metavar="S", help="--live: measured at each rate (default: 20)"
    )
    parser.add_argument(
        "--graph", choices=("processes", "single"), default="processes", help="--live: five processes, or one"
    )
    parser.set_defaults(command=_bench)


def _bench_live(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from hat_ros.bench.live.tables import LiveBench
    from hat_ros.cli.console import log_shown
    from hat_ros.config import load_config
    from hat_ros.errors import UsageError
    from hat_ros.io.own_folder import checked_out

    if len(arguments.recordings) != 1 or min(arguments.rates) < 1:
        raise UsageError("--live takes one bag and rates of at least 1 Hz: hat bench --live BAG --out DIR")
    out = checked_out(arguments.out).resolve()
    config = load_config(arguments.config, arguments.overrides)
    bench = LiveBench(Path(arguments.recordings[0]), config, arguments.graph, float(arguments.seconds))
    out.mkdir(parents=True, exist_ok=True)
    with log_shown(Console(stderr=True)):
        for name, table in bench.tables([float(rate) for rate in arguments.rates]):
            print(table.text())
            table.write(out, name)
    return 0


def _bench(arguments: argparse.Namespace) -> int:
    if arguments.live:
        return _bench_live(arguments)
    from hat_ros.bench.evaluation.figures import image_bytes
    from hat_ros.bench.experiments import comparison
    from hat_ros.bench.experiments.comparison_figure import bench_figure
    from hat_ros.bench.experiments.run_matrix import run_jobs
    from hat_ros.cli.console import matrix_progress
    from hat_ros.io.own_folder import checked_out

    out = checked_out(arguments.out).resolve()
    methods = [comparison.Entry.parse(text, arguments.config) for text in arguments.methods]
    jobs = comparison.bench_jobs(
        _clips(arguments),
        arguments.modes or ([] if methods else ["hat", "independent"]),
        arguments.masks,
        arguments.start,
        arguments.config,
        (*protocol_settings(arguments), *arguments.overrides),
        arguments.limit,
        dict(arguments.poses),
        methods,
    )
    with matrix_progress(len(jobs)) as watch:
        outcomes = run_jobs(jobs, out, arguments.jobs, watch)
    table, stages, groups = (
        comparison.bench_table(outcomes),
        comparison.stage_table(outcomes),
        comparison.group_table(outcomes),
    )
    for name, written in (("table", table), ("stages", stages), ("groups", groups)):
        written.write(out, name)
    for form in ("png", "svg"):
        (out / f"bench.{form}").write_bytes(image_bytes(bench_figure(table.rows), form))
        if groups.rows:
            (out / f"groups.{form}").write_bytes(image_bytes(bench_figure(groups.rows, "group"), form))
    print(table.text())
    print(groups.text())
    failures = comparison.failures(outcomes)
    for line in failures:
        print(f"failed: {line}", file=sys.stderr)
    return 1 if failures else 0


_ABLATE_TABLES = """\
tables, each as NAME.txt, .csv, .tex, .json, .png and .svg below --out:
  components    what each part of the method adds, row by row
  sensitivity   anchor stride, K, s0, D, w: one setting at a time
  selectors     best appearance, the decoder, the offline backtrace, and a particle filter and a UKF at their best
  filters       the search for that best
  offline       independent, causal and offline (whole-clip smoothing) poses from the same observations
  by_clip       the same, E_p clip by clip (no figure)
  masks         motion from the masked target and from raw frames
  candidates    best of the K candidates of every image, clip by clip (no figure)
  ranges        errors of the best appearance by range
trace.json names the runs behind every table and the settings behind every row.
"""


def _add_ablate(commands: Commands) -> None:
    parser = commands.add_parser(
        "ablate",
        help="component table, sensitivity sweeps, filters, offline reference",
        description="Run the front ends once per clip, then Stages 3 and 4 over what they saw, under every setting of\n"
        "the paper's ablations. --config decides the temporal settings; --front-end, if given, takes segmentation,\n"
        "hypotheses and motion (and what belongs to its scores) from another preset.",
        epilog=_ABLATE_TABLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_run_matrix(parser)
    parser.add_argument("--front-end", metavar="NAME|FILE", help="preset of the front ends (default: that of --config)")
    parser.set_defaults(command=_ablate)


def _ablate(arguments: argparse.Namespace) -> int:
    from hat_ros.bench.evaluation.figures import image_bytes
    from hat_ros.bench.experiments import ablation
    from hat_ros.bench.experiments.ablation_figure import table_figure
    from hat_ros.bench.experiments.run_matrix import run_jobs
    from hat_ros.cli.console import matrix_progress
    from hat_ros.io.own_folder import checked_out
    from hat_ros.io.results import write_json

    out = checked_out(arguments.out).resolve()
    overrides = (*protocol_settings(arguments), *arguments.overrides)
    plan = ablation.plan(_clips(arguments), out, arguments.config, arguments.front_end, overrides, arguments.limit)
    with matrix_progress(len(plan.jobs)) as watch:
        outcomes = run_jobs(plan.jobs, out, arguments.jobs, watch)
    for name, table in ablation.tables(plan, outcomes).items():
        table.write(out, name)
        for form in ("png", "svg"):
            if (figure := table_figure(table)) is not None:
                (out / f"{name}.{form}").write_bytes(image_bytes(figure, form))
        print(table.text())
    write_json(out / "trace.json", ablation.trace(plan, outcomes))
    failed = [f"{outcome.job.name}: {outcome.failure}" for outcome in outcomes if outcome.figures is None]
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return 1 if failed else 0
