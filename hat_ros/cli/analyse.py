"""``hat evaluate``, ``hat plot``, ``hat score``: what a run is worth."""

from __future__ import annotations

import argparse
from pathlib import Path

from hat_ros.cli.options import (
    Commands,
    add_camera,
    add_dataset,
    add_extent,
    add_out,
    add_protocol,
    add_topics,
    extent_of,
    spec_of,
)


def add_commands(commands: Commands) -> None:
    """Register this group."""
    _add_evaluate(commands)
    _add_plot(commands)
    _add_score(commands)


def _add_evaluate(commands: Commands) -> None:
    parser = commands.add_parser(
        "evaluate",
        help="score a finished run again",
        description="Compute the metrics of a result folder again from its bag, rewrite poses.csv, metrics.json and "
        "report.html, and print the main figures.",
    )
    parser.add_argument(
        "folder", type=Path, metavar="DIR", help="result folder of `hat replay`, `hat track` or `hat score`"
    )
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="BAG",
        help="recording whose ground truth counts (default: that in the result bag)",
    )
    add_topics(parser)
    parser.set_defaults(command=_evaluate)


def _evaluate(arguments: argparse.Namespace) -> int:
    from hat_ros.bench.evaluation.result_folder import evaluate_folder
    from hat_ros.cli.console import print_figures

    evaluate_folder(arguments.folder, arguments.truth, arguments.image_topic, arguments.camera_info_topic)
    print_figures(arguments.folder)
    return 0


def _add_plot(commands: Commands) -> None:
    parser = commands.add_parser(
        "plot",
        help="plots of a finished run as image files",
        description="Draw the errors over time, and by range, of a result folder.",
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="result folder")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where the images go (default: DIR/plots)")
    parser.add_argument("--format", choices=("png", "svg", "pdf"), default="png", help="image format (default: png)")
    parser.set_defaults(command=_plot)


def _plot(arguments: argparse.Namespace) -> int:
    from hat_ros.bench.evaluation.result_folder import plot_folder

    for path in plot_folder(arguments.folder, arguments.out or arguments.folder / "plots", arguments.format):
        print(path)
    return 0


def _add_score(commands: Commands) -> None:
    parser = commands.add_parser(
        "score",
        help="score the poses of another tracker, as a run like any other",
        description="Score the poses that another tracker (RGBTrack, FoundationPose, your own) made of a recording, "
        "and write a result folder. FILE is TUM (stamp in seconds, x y z qx qy qz qw), or, ending in .csv, BOP "
        "(scene_id,im_id,obj_id,score,R,t,time), or a folder of NUMBER.txt with a 4 x 4 matrix each. Poses map the "
        "CAD file's own axes to the OpenCV camera, in metres (BOP: millimetres). `hat bench --poses NAME=FILE` puts "
        "them into the table beside the others.",
    )
    parser.add_argument("recording", type=Path, help="bag, folder of the `sequence` layout, or root of a data set")
    parser.add_argument(
        "--poses", required=True, type=Path, metavar="FILE", help="TUM or BOP file, or folder of matrices"
    )
    parser.add_argument("--method", default="external", metavar="NAME", help="its name in tables (default: external)")
    add_camera(parser)
    parser.add_argument("--fps", type=float, metavar="X", help="its frame rate, if you measured it")
    add_dataset(parser)
    add_protocol(parser, "none")
    add_topics(parser)
    parser.add_argument("--sequence", default="", metavar="NAME", help="which sequence of the data set")
    add_out(parser, "result folder to write")
    add_extent(parser)
    parser.set_defaults(command=_score)


def _score(arguments: argparse.Namespace) -> int:
    from hat_ros.bench.runs.external import ScoreOptions, score_poses
    from hat_ros.cli.console import print_figures
    from hat_ros.config import load_config

    camera = load_config("default", arguments.overrides).camera
    options = ScoreOptions(method=arguments.method, fps=arguments.fps, camera=camera, **extent_of(arguments))
    folder = score_poses(spec_of(arguments), arguments.poses, arguments.out, options)
    if not arguments.quiet:
        print_figures(folder)
    return 0
