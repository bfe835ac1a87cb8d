"""``hat train``: networks of the package trained again, on any craft."""

from __future__ import annotations

import argparse
from pathlib import Path

from hat_ros.cli.options import Commands, add_threads, limit_threads, natural, positive

_EXAMPLES = """\
examples:
  hat train segmenter --out out/segmenter                            as far as a clone can rebuild the shipped network
  hat train segmenter --cad my.glb --kept-cad other.glb --out out/mine
  hat track CLIP --set segmentation.backend=learned --set segmentation.learned.weights=out/mine/segmenter.onnx --out DIR
"""


def add_commands(commands: Commands) -> None:
    """Register this group."""
    parser = commands.add_parser(
        "train",
        help="train the segmentation network again, on your own craft",
        description="Train a network of the package from a seed.",
    )
    actions = parser.add_subparsers(title="networks", metavar="NETWORK", required=True)
    _add_segmenter(actions)


def _add_segmenter(actions: Commands) -> None:
    parser = actions.add_parser(
        "segmenter",
        help="the network of segmentation.backend: learned",
        description="Render craft and backgrounds, train the segmentation network on images composed from them,\n"
        "calibrate and measure it on craft kept aside, and write segmenter.onnx with a model card. What is done\n"
        "already is used again: after Ctrl-C, start the same command.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder of the training; resumed")
    parser.add_argument(
        "--cad",
        dest="cads",
        nargs="+",
        type=Path,
        default=[],
        metavar="FILE",
        help="CAD files in metres, or target.yaml files, to train on beside generated craft",
    )
    parser.add_argument(
        "--kept-cad",
        dest="kept_cads",
        nargs="+",
        type=Path,
        default=[],
        metavar="FILE",
        help="CAD files that are never trained on: calibration and figures come from them and generated craft",
    )
    parser.add_argument("--generated", type=natural, default=840, metavar="N", help="generated craft (default: 840)")
    parser.add_argument(
        "--views",
        type=positive,
        default=20,
        metavar="N",
        help="views of each generated craft; 12 times as many of a CAD file, 6 times of the package's own models "
        "(default: 20)",
    )
    parser.add_argument("--backgrounds", type=positive, default=4000, metavar="N", help="backgrounds (default: 4000)")
    parser.add_argument("--steps", type=positive, default=9500, metavar="N", help="steps of 32 samples (default: 9500)")
    parser.add_argument("--seed", type=natural, default=0, help="of everything that is drawn in training (default: 0)")
    add_threads(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress bars, no figures")
    parser.set_defaults(command=_segmenter)


def _segmenter(arguments: argparse.Namespace) -> int:
    limit_threads(arguments.threads)
    from hat_ros.bench.training.card import overlap_table
    from hat_ros.bench.training.recipe import Recipe
    from hat_ros.bench.training.train import train
    from hat_ros.cli.console import count_progress
    from hat_ros.io.own_folder import checked_out

    recipe = Recipe(
        tuple(arguments.cads),
        tuple(arguments.kept_cads),
        arguments.generated,
        arguments.views,
        arguments.backgrounds,
        arguments.steps,
        arguments.seed,
    )
    out = checked_out(arguments.out).resolve()
    with count_progress(arguments.quiet) as progress:
        card = train(recipe, out, progress)
    if not arguments.quiet:
        print(overlap_table(card["overlap"]).text(), end="")
    return 0
