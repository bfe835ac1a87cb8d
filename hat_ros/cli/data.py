"""``hat import`` and ``hat synth``: recordings from data sets and from CAD models."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from hat_ros.cli.footage import FOOTAGE, add_footage, import_footage, refuse_footage_options
from hat_ros.cli.options import FORMATS, Commands, DefaultsFormatter, natural, positive

if TYPE_CHECKING:
    from hat_ros.bench.synth.suite import Clip


def add_commands(commands: Commands) -> None:
    """Register this group."""
    _add_import(commands)
    _add_synth(commands)


def _add_import(commands: Commands) -> None:
    parser = commands.add_parser(
        "import",
        help="a data set, a film or a folder of images to bags",
        description="Read a film (`video`) or a folder of images (`images`) with a calibration, or a data set in the "
        "layout in which it is published, and write one bag per sequence, with images, calibration, given masks or "
        "boxes, and the ground truth (for evaluation only). Bags of data sets that are complete already are left "
        "alone.",
    )
    parser.add_argument("format", choices=(*FORMATS, *FOOTAGE), help="layout of SRC")
    parser.add_argument("source", type=Path, metavar="SRC", help="folder of the data set (or of one clip), or a film")
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
    parser.add_argument(
        "--instance",
        type=natural,
        metavar="N",
        help="of several instances of one object in a BOP scene only number N, from 0 on (default: a bag of each)",
    )
    regions = parser.add_mutually_exclusive_group()
    regions.add_argument(
        "--boxes",
        action="store_true",
        help="give frames without a mask the box of the CAD at the true pose (as for SHIRT)",
    )
    regions.add_argument(
        "--detections",
        type=Path,
        metavar="PATH",
        help="masks or boxes computed elsewhere, instead of the data set's own: JSON as from CNOS (run lengths or "
        "bbox), JSON of boxes by file name, or a folder of mask images; for several sequences a folder with NAME.json "
        "or NAME/ for each",
    )
    parser.add_argument("--check", action="store_true", help="also write a picture of the CAD projected by the labels")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    add_footage(parser)
    parser.set_defaults(command=_import)


def _import(arguments: argparse.Namespace) -> int:
    if arguments.format in FOOTAGE:
        return import_footage(arguments)
    refuse_footage_options(arguments)
    from hat_ros.bench.datasets.importer import import_dataset
    from hat_ros.cli.console import count_progress

    with count_progress(arguments.quiet) as watch:
        bags = import_dataset(
            arguments.format,
            arguments.source,
            arguments.out,
            model=arguments.model,
            sequences=arguments.sequence,
            boxes=arguments.boxes,
            detections=arguments.detections,
            instance=arguments.instance,
            check=arguments.check,
            progress=watch,
        )
    for bag in bags:
        print(bag)
    return 0


def _add_synth(commands: Commands) -> None:
    parser = commands.add_parser(
        "synth",
        help="a clip rendered from a CAD model, with exact ground truth",
        description="Render a tumbling spacecraft in sunlight. WHAT is a CAD file in metres, a target.yaml, a model of "
        "this package, a named clip (its settings are fixed), `suite` (all clips of the synthetic benchmark), or "
        "`list`.",
        formatter_class=DefaultsFormatter,
    )
    parser.add_argument("what", metavar="WHAT", help="CAD file, model, clip, `suite` or `list`")
    parser.add_argument("--out", type=Path, metavar="DIR", help="what to write; for `suite` the folder of all bags")
    parser.add_argument(
        "--format", choices=("bag", "sequence"), default="bag", help="rosbag2 folder or images + labels"
    )
    parser.add_argument("--width", type=positive, metavar="PX", help="named clips and suite: images at most this wide")
    parser.add_argument("--limit", type=positive, metavar="N", help="at most N frames per clip of the suite")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    film = parser.add_argument_group("how a model is filmed")
    film.add_argument("--frames", type=positive, default=200, help="number of frames, 0.1 s apart")
    film.add_argument("--size", type=positive, nargs=2, default=(640, 480), metavar=("W", "H"), help="image size, px")
    film.add_argument("--focal", type=float, default=1000.0, metavar="PX", help="focal length, px")
    film.add_argument(
        "--range", type=float, nargs=2, default=(12.0, 6.0), metavar=("FIRST", "LAST"), help="distance, m"
    )
    film.add_argument("--spin", type=float, default=1.0, metavar="DEG", help="rotation rate, degrees per frame")
    film.add_argument("--precession", type=float, default=0.0, metavar="DEG", help="rate of the spin axis, deg/frame")
    film.add_argument(
        "--axis", type=float, nargs=3, default=(0.3, 0.2, 1.0), metavar=("X", "Y", "Z"), help="spin axis, target frame"
    )
    film.add_argument(
        "--sun", type=float, nargs=3, default=(-1.0, -0.8, -1.0), metavar=("X", "Y", "Z"), help="to the sun, camera"
    )
    film.add_argument("--exposure", type=float, default=0.85, help="brightness of a white face square to the sun")
    film.add_argument("--noise", type=float, default=0.0008, help="read noise, share of full scale")
    film.add_argument("--monochrome", action="store_true", help="a grey sensor")
    film.add_argument(
        "--glare", type=float, default=0.0, metavar="0..1", help="stray light of a sun at the upper right, its peak"
    )
    film.add_argument("--stars", type=natural, default=0, metavar="N", help="stars in the field")
    film.add_argument("--background", choices=("black", "earth", "table"), default="black", help="behind the target")
    film.add_argument(
        "--asymmetry", type=float, default=1.0, metavar="0..1", help="of this package's models; 0 makes them ambiguous"
    )
    film.add_argument(
        "--panel-turn", type=float, default=0.0, metavar="DEG", help="wings turned against those of the CAD"
    )
    film.add_argument(
        "--recolor", type=float, default=0.0, metavar="0..1", help="colours of the spacecraft differ from its CAD"
    )
    film.add_argument(
        "--missing", type=float, default=0.0, metavar="0..1", help="share of the CAD's parts that the spacecraft lacks"
    )
    film.add_argument("--seed", type=natural, default=0, help="of noise, stars and textures")
    parser.set_defaults(command=_synth)


def _synth(arguments: argparse.Namespace) -> int:
    from hat_ros.bench.synth import suite
    from hat_ros.bench.synth.models import model_names
    from hat_ros.cli.console import count_progress
    from hat_ros.errors import UsageError

    what = arguments.what
    if what == "list":
        print(f"models: {', '.join(model_names())}\nclips: {', '.join(suite.CLIPS)}")
        return 0
    if arguments.out is None:
        raise UsageError("synth: --out is missing; it names what to write")
    with count_progress(arguments.quiet) as watch:
        if what == "suite":
            written = suite.write_suite(arguments.out, arguments.width, arguments.limit, watch)
        else:
            clip = suite.CLIPS[what].within(arguments.width) if what in suite.CLIPS else _filmed(arguments)
            written = [suite.synthesize(clip, arguments.out, arguments.format == "bag", watch)]
    for path in written:
        print(path)
    return 0


def _filmed(arguments: argparse.Namespace) -> Clip:
    """The clip that the options describe."""
    from hat_ros.bench.synth.backdrop import Earth
    from hat_ros.bench.synth.clips import ClipSpec
    from hat_ros.bench.synth.mismatch import Mismatch
    from hat_ros.bench.synth.models import model_names
    from hat_ros.bench.synth.suite import CLIPS, Clip
    from hat_ros.errors import UsageError

    if arguments.what not in model_names() and not Path(arguments.what).is_file():
        known = ", ".join((*model_names(), *CLIPS))
        raise UsageError(f"synth: '{arguments.what}' is neither a CAD file nor one of {known}, suite, list")
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
        monochrome=arguments.monochrome,
        glare=arguments.glare,
        seed=arguments.seed,
    )
    mismatch = Mismatch(arguments.panel_turn, arguments.recolor, arguments.missing, arguments.seed)
    return Clip(arguments.what, spec, arguments.asymmetry, mismatch)
