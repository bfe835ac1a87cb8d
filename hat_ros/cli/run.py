"""``hat replay``, ``hat track``, ``hat temporal``: poses from recordings."""

from __future__ import annotations

import argparse
from pathlib import Path

from hat_ros.bench.methods.modes import MODES
from hat_ros.cli.options import (
    Commands,
    add_camera,
    add_config,
    add_dataset,
    add_extent,
    add_out,
    add_protocol,
    add_threads,
    add_topics,
    config_of,
    extent_of,
    limit_threads,
    natural,
    positive,
    spec_of,
)


def add_commands(commands: Commands) -> None:
    """Register this group."""
    _add_replay(commands)
    _add_track(commands)
    _add_temporal(commands)


def _add_replay(commands: Commands) -> None:
    parser = commands.add_parser(
        "replay",
        help="a recorded bag through the five-node ROS graph",
        description="Play a bag through the real ROS graph without losing a frame, record its topics, and write a "
        "result folder.",
    )
    parser.add_argument("bag", type=Path, help="bag folder or .mcap file, with the CAD model and target.yaml beside it")
    add_out(parser, "result folder to write")
    add_config(parser)
    parser.add_argument(
        "--graph",
        choices=("processes", "single"),
        default="processes",
        help="five processes, or all nodes in one (default: processes)",
    )
    add_topics(parser)
    add_camera(parser)
    _add_credits(parser, "graph.credits_replay")
    parser.add_argument("--live", action="store_true", help="play in real time; frames are dropped, not queued")
    parser.add_argument("--rate", type=float, default=1.0, metavar="X", help="speed of --live play (default: 1)")
    parser.add_argument(
        "--domain",
        type=natural,
        metavar="ID",
        help="ROS domain to play in, so that nodes of your own can listen (default: one that is free)",
    )
    add_extent(parser)
    parser.set_defaults(command=_replay)


def _add_credits(parser: argparse.ArgumentParser, default: str) -> None:
    parser.add_argument(
        "--credits",
        type=positive,
        metavar="W",
        help=f"frames in flight; the poses do not depend on it (default: {default})",
    )


def _replay(arguments: argparse.Namespace) -> int:
    from hat_ros.bench.runs.replay import ReplayOptions, replay_bag
    from hat_ros.cli.console import print_figures, print_refused, state_progress

    options = ReplayOptions(
        graph=arguments.graph,
        credits=arguments.credits,
        live=arguments.live,
        rate=arguments.rate,
        domain=arguments.domain,
        image_topic=arguments.image_topic,
        camera_info_topic=arguments.camera_info_topic,
        **extent_of(arguments),
    )
    with state_progress("replaying", arguments.quiet) as watch:
        folder = replay_bag(arguments.bag, arguments.out, config_of(arguments), options, watch)
    print_refused(folder)
    if not arguments.quiet:
        print_figures(folder)
    return 0


def _add_track(commands: Commands) -> None:
    parser = commands.add_parser(
        "track",
        help="a recording through the method in this process, no ROS needed",
        description="Run the method over a bag or a sequence folder in this process and write a result folder. "
        "Gives the same poses as `hat replay`, byte for byte.",
    )
    parser.add_argument("recording", type=Path, help="bag, folder of the `sequence` layout, or root of a data set")
    add_dataset(parser)
    add_protocol(parser, "none")
    parser.add_argument("--sequence", default="", metavar="NAME", help="which sequence of the data set")
    add_out(parser, "result folder to write")
    add_config(parser)
    parser.add_argument(
        "--mode",
        choices=MODES,
        default="hat",
        help="hat: the paper's method; independent: best hypothesis of every frame; tracking: refine the last pose; "
        "offline: all frames jointly (whole-clip smoothing, not causal); srt3d: region tracker started by the best "
        "hypothesis; observe: front ends only, candidates at every frame, no poses (default: hat)",
    )
    add_topics(parser)
    add_camera(parser)
    _add_credits(parser, "2, or graph.credits_replay where that is less")
    add_extent(parser)
    add_threads(parser)
    parser.set_defaults(command=_track)


def _track(arguments: argparse.Namespace) -> int:
    limit_threads(arguments.threads)
    from hat_ros.bench.runs.track import TrackOptions, track
    from hat_ros.cli.console import print_figures, print_refused, state_progress

    spec = spec_of(arguments)
    options = TrackOptions(
        mode=arguments.mode,
        credits=arguments.credits,
        **extent_of(arguments),
    )
    with state_progress("tracking", arguments.quiet) as watch:
        folder = track(spec, arguments.out, config_of(arguments), options, watch)
    print_refused(folder)
    if not arguments.quiet:
        print_figures(folder)
    return 0


def _add_temporal(commands: Commands) -> None:
    parser = commands.add_parser(
        "temporal",
        help="selection and fusion alone (stages 3 and 4) over recorded observations",
        description="Run selection, alignment and fusion over an .npz file with slam (N,4,4) T_slam_cam (NaN = none), "
        "key (N,) bool, poses (N,K,4,4) T_cam_target, scores (N,K) and optionally box_area_px (N,). "
        "Writes T_cam_target (N,4,4), chosen (N,), accepted (N,) and resets.",
    )
    parser.add_argument("observations", type=Path, metavar="OBS.npz", help="recorded observations")
    parser.add_argument("--out", required=True, type=Path, metavar="OUT.npz", help="file to write")
    add_config(parser)
    parser.add_argument(
        "--mode",
        choices=("hat", "offline"),
        default="hat",
        help="hat: causal; offline: all frames jointly, whole-clip smoothing (default: hat)",
    )
    parser.set_defaults(command=_temporal)


def _temporal(arguments: argparse.Namespace) -> int:
    from hat_ros.bench.methods.temporal import run_offline, run_temporal, save_result
    from hat_ros.bench.observations import load_observations

    run = run_offline if arguments.mode == "offline" else run_temporal
    config = config_of(arguments)
    save_result(arguments.out, run(load_observations(arguments.observations), config))
    return 0
