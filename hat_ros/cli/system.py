"""``hat weights``, ``doctor``, ``prepare`` and ``profile``: what is on this machine, and what it can do."""

from __future__ import annotations

import argparse
from pathlib import Path

from hat_ros.cli.options import (
    Commands,
    add_camera,
    add_config,
    add_dataset,
    add_threads,
    add_topics,
    add_unit_scale,
    config_of,
    limit_threads,
    positive,
    spec_of,
)


def add_commands(commands: Commands) -> None:
    """Register this group."""
    _add_weights(commands)
    _add_doctor(commands)
    _add_prepare(commands)
    _add_profile(commands)


def _add_weights(commands: Commands) -> None:
    parser = commands.add_parser(
        "weights",
        help="public network weights: list, check, convert",
        description="What the learned backends need, whether it is here and unaltered, and the one-time conversion of "
        "pickled checkpoints to safetensors. Nothing is ever downloaded.",
    )
    parser.add_argument(
        "action",
        choices=("list", "check", "convert"),
        help="list: name, source, licence, place; check: presence, SHA-256, and that the network takes it; "
        "convert: pickled file to safetensors",
    )
    parser.add_argument("name", nargs="?", help="one checkpoint (default: all)")
    parser.add_argument("--weights", type=Path, metavar="DIR", help="weights folder (default: $HAT_WEIGHTS)")
    parser.add_argument("--source", type=Path, metavar="FILE", help="convert: the pickled file, if it lies elsewhere")
    parser.add_argument(
        "--allow-unverified", action="store_true", help="check, convert: take another checksum than the published one"
    )
    parser.set_defaults(command=_weights)


def _weights(arguments: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table

    from hat_ros.errors import UsageError
    from hat_ros.nets import checkpoint
    from hat_ros.nets.checkpoint_registry import CHECKPOINTS

    names = [arguments.name] if arguments.name else list(CHECKPOINTS)
    if arguments.action == "convert":
        if not arguments.name:
            raise UsageError("weights convert: name the checkpoint, `hat weights list` shows them")
        print(checkpoint.convert(arguments.name, arguments.source, arguments.weights, arguments.allow_unverified))
        return 0
    if arguments.action == "check":
        from hat_ros.nets.checkpoint_check import check

        found = [check(name, arguments.weights, arguments.allow_unverified) for name in names]
        for status in found:
            name = status.checkpoint.name
            verdict = "ok" if status.usable else "missing" if status.path is None else "unusable"
            print(f"{name}: {verdict}: {status.message.removeprefix(f'{name}: ')}")
        return 0 if all(status.usable for status in found) else 1
    table = Table(title=f"weights folder: {checkpoint.weights_folder(arguments.weights)}")
    for heading in ("name", "file below the folder", "size", "licence", "source", "SHA-256"):
        table.add_column(heading, overflow="fold")
    for entry in map(checkpoint.checkpoint_named, names):
        table.add_row(entry.name, entry.filename, entry.size, entry.licence, entry.source, entry.sha256 or "-")
    Console().print(table)
    return 0


def _add_doctor(commands: Commands) -> None:
    parser = commands.add_parser(
        "doctor",
        help="check that what a run needs is installed and works",
        description="Check Python, packages, ROS, DDS, renderer, presets, cache and weights; exit code 1 if something "
        "that `hat track` or `hat replay` needs is missing.",
    )
    parser.set_defaults(command=_doctor)


def _doctor(_: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from hat_ros.app.doctor import run_checks

    findings = run_checks()
    table = Table(title="hat doctor")
    for heading in ("check", "", "found"):
        table.add_column(heading, overflow="fold")
    style = {"ok": "green", "missing": "red", "optional": "yellow", "untested": "yellow"}
    for finding in findings:
        table.add_row(finding.what, Text(finding.verdict, style[finding.verdict]), Text(finding.found))
    Console().print(table)
    return 1 if any(finding.verdict == "missing" for finding in findings) else 0


def _add_prepare(commands: Commands) -> None:
    parser = commands.add_parser(
        "prepare",
        help="build ahead what the first start with a CAD model builds",
        description="Build the view banks of a CAD model and compile what is compiled at the first use, so that later "
        "starts are fast; say how long each part took, and how long it takes from now on. Both are kept in the user's "
        "cache folder. `hat track`, `hat replay` and the nodes do the same at their first start.",
    )
    parser.add_argument("cad", type=Path, metavar="CAD", help="CAD file or target.yaml")
    add_unit_scale(parser, "of a CAD file")
    add_config(parser)
    parser.set_defaults(command=_prepare)


def _prepare(arguments: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table

    from hat_ros.app.prepare import prepare
    from hat_ros.target.loading import load_target

    target = load_target(arguments.cad, arguments.unit_scale)
    config = config_of(arguments)
    first, again = prepare(config, target), prepare(config, target)
    table = Table(title=str(arguments.cad))
    for heading in ("part", "now", "from now on"):
        table.add_column(heading, justify="left" if heading == "part" else "right")
    for part, later in zip(first, again, strict=True):
        table.add_row(part.name, f"{part.seconds:.2f} s", f"{later.seconds:.2f} s")
    table.add_row("in all", *(f"{sum(part.seconds for part in parts):.2f} s" for parts in (first, again)))
    Console().print(table)
    return 0


def _add_profile(commands: Commands) -> None:
    parser = commands.add_parser(
        "profile",
        help="network passes, renders, time and memory per keyframe",
        description="Run HAT over a recording, count every network pass and render, and time stages and networks: per "
        "keyframe, per frame between keyframes, and once at the start (weights, templates, first keyframe). Stages run "
        "one after another; `hat bench --modes hat,graph` measures them overlapped.",
    )
    parser.add_argument("recording", type=Path, help="bag, folder of the `sequence` layout, or root of a data set")
    add_dataset(parser)
    parser.add_argument("--sequence", default="", metavar="NAME", help="which sequence of the data set")
    add_config(parser)
    add_topics(parser)
    add_camera(parser)
    parser.add_argument("--limit", type=positive, metavar="N", help="at most N frames (default: all)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there as well")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    add_threads(parser)
    parser.set_defaults(command=_profile)


def _profile(arguments: argparse.Namespace) -> int:
    limit_threads(arguments.threads)
    from hat_ros.bench.experiments.profile import profile
    from hat_ros.cli.console import state_progress
    from hat_ros.io.results import write_json

    config = config_of(arguments)
    source = spec_of(arguments).open(config.camera)
    with state_progress("profiling", arguments.quiet) as watch:
        measured = profile(source, config, arguments.limit, watch)
    print(measured.table().text())
    for name, value in measured.summary().items():
        print(f"{name}: {value:.1f}" if isinstance(value, float) else f"{name}: {value}")
    if arguments.json is not None:
        write_json(arguments.json, measured.summary() | {"parts": list(measured.table().rows)})
    return 0
