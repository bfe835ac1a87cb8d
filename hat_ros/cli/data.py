"""``hat import`` and ``hat synth``: recordings from data sets and from CAD models."""

from __future__ import annotations

import argparse
import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hat_ros.cli.options import Commands, natural, positive

if TYPE_CHECKING:
    from hat_ros.datasets.synth import ClipSpec

FORMATS = ("sequence", "spark", "shirt", "swisscube", "bop")


def add_commands(commands: Commands) -> None:
    """Register this group."""
    _add_import(commands)
    _add_synth(commands)


def _add_import(commands: Commands) -> None:
    parser = commands.add_parser(
        "import",
        help="a data set in its own layout to bags",
        description="Read a data set in the layout in which it is published and write one bag per sequence, with "
        "images, calibration, given masks or boxes, and the truth (for evaluation only). Bags that are complete "
        "already are left alone.",
    )
    parser.add_argument("format", choices=FORMATS, help="layout of SRC")
    parser.add_argument("source", type=Path, metavar="SRC", help="folder of the data set (or of one clip)")
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        metavar="BAG",
        help="bag to write; for data sets the folder that gets one bag per sequence",
    )
    parser.add_argument("--model", type=Path, metavar="CAD", help="metric CAD model, for data sets that bring none")
    parser.add_argument(
        "--sequence", action="append", default=[], metavar="NAME", help="only this sequence (repeatable)"
    )
    parser.add_argument("--check", action="store_true", help="also write a picture of the CAD projected by the labels")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(command=_import)


def _import(arguments: argparse.Namespace) -> int:
    from hat_ros.cli.console import count_progress
    from hat_ros.datasets.importer import import_dataset

    with count_progress(arguments.quiet) as watch:
        bags = import_dataset(
            arguments.format,
            arguments.source,
            arguments.out,
            model=arguments.model,
            sequences=arguments.sequence,
            check=arguments.check,
            progress=watch,
        )
    for bag in bags:
        print(bag)
    return 0


def _add_synth(commands: Commands) -> None:
    parser = commands.add_parser(
        "synth",
        help="a clip rendered from a CAD model, with exact truth",
        description="Render a clip of a tumbling spacecraft in sunlight and write it in the `sequence` layout.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("model", metavar="MODEL", help="CAD file (metres), or one of our own: see `hat synth list`")
    parser.add_argument("--out", type=Path, metavar="DIR", help="clip folder to write")
    parser.add_argument("--frames", type=positive, default=200, help="number of frames, 0.1 s apart")
    parser.add_argument("--size", type=positive, nargs=2, default=(640, 480), metavar=("W", "H"), help="image size, px")
    parser.add_argument("--focal", type=float, default=1000.0, metavar="PX", help="focal length, px")
    parser.add_argument(
        "--range", type=float, nargs=2, default=(12.0, 6.0), metavar=("FIRST", "LAST"), help="distance, m"
    )
    parser.add_argument("--spin", type=float, default=1.0, metavar="DEG", help="rotation rate, degrees per frame")
    parser.add_argument("--precession", type=float, default=0.0, metavar="DEG", help="rate of the spin axis, deg/frame")
    parser.add_argument(
        "--axis", type=float, nargs=3, default=(0.3, 0.2, 1.0), metavar=("X", "Y", "Z"), help="spin axis, target frame"
    )
    parser.add_argument(
        "--sun",
        type=float,
        nargs=3,
        default=(-1.0, -0.8, -1.0),
        metavar=("X", "Y", "Z"),
        help="to the sun, camera frame",
    )
    parser.add_argument("--exposure", type=float, default=0.85, help="brightness of a white face square to the sun")
    parser.add_argument("--noise", type=float, default=0.0008, help="read noise, share of full scale")
    parser.add_argument("--stars", type=natural, default=0, metavar="N", help="stars in the field")
    parser.add_argument("--background", choices=("black", "earth", "table"), default="black", help="behind the target")
    parser.add_argument(
        "--asymmetry", type=float, default=1.0, metavar="0..1", help="of our own models; 0 makes them ambiguous"
    )
    parser.add_argument("--seed", type=natural, default=0, help="of noise, stars and textures")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(command=_synth)


def _synth(arguments: argparse.Namespace) -> int:
    from hat_ros.datasets.backdrop import Earth
    from hat_ros.datasets.models import model_names
    from hat_ros.datasets.synth import ClipSpec
    from hat_ros.errors import UsageError

    if arguments.model == "list":
        print("\n".join(model_names()))
        return 0
    if arguments.out is None:
        raise UsageError("synth: --out is missing; it names the clip folder to write")
    spec = ClipSpec(
        frames=arguments.frames,
        width=arguments.size[0],
        height=arguments.size[1],
        focal_px=arguments.focal,
        range_m=tuple(arguments.range),
        spin_axis=tuple(arguments.axis),
        spin_deg_per_frame=arguments.spin,
        precession_deg_per_frame=arguments.precession,
        to_sun_cam=tuple(arguments.sun),
        exposure=arguments.exposure,
        noise=arguments.noise,
        star_count=arguments.stars,
        earth=Earth() if arguments.background == "earth" else None,
        table=arguments.background == "table",
        seed=arguments.seed,
    )
    print(_render(arguments, spec))
    return 0


def _render(arguments: argparse.Namespace, spec: ClipSpec) -> Path:
    """Render a clip of one of our own models or of a CAD file."""
    from hat_ros.cli.console import count_progress
    from hat_ros.datasets.models import model_names, write_model
    from hat_ros.datasets.synth import write_clip
    from hat_ros.target import load_target

    with tempfile.TemporaryDirectory() as folder, count_progress(arguments.quiet) as watch:
        model = Path(arguments.model)
        if arguments.model in model_names():
            model = Path(folder) / f"{arguments.model}.glb"
            write_model(arguments.model, model, arguments.asymmetry)
        return write_clip(load_target(model), model, arguments.out, spec, progress=partial(watch, model.stem))
