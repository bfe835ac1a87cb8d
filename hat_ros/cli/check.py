"""``hat check``: a look at a recording and its CAD model before a run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from hat_ros.cli.options import (
    Commands,
    add_camera,
    add_config,
    add_dataset,
    add_topics,
    add_unit_scale,
    config_of,
    positive,
    spec_of,
)

if TYPE_CHECKING:
    from hat_ros.array_types import UInt8
    from hat_ros.bench.check import Line


def add_commands(commands: Commands) -> None:
    """Register this group."""
    parser = commands.add_parser(
        "check",
        help="a look at a recording and its CAD model before a run",
        description="Say what a recording and its CAD model are, with the warnings that reading them gives in a run: "
        "topics, stamps, refused frames, calibration, size of the target, unit and axes of the CAD model. No pose is "
        "estimated, and nothing is written but FILE. Exit code 0: a run can read it; 2: it cannot, and one sentence "
        "says why.",
    )
    parser.add_argument(
        "recording",
        type=Path,
        help="bag, folder of the `sequence` layout, root of a data set, or a CAD file or target.yaml alone",
    )
    add_dataset(parser)
    parser.add_argument("--sequence", default="", metavar="NAME", help="which sequence of the data set")
    add_unit_scale(parser, "of a CAD file alone")
    add_config(parser)
    add_topics(parser)
    add_camera(parser)
    parser.add_argument("--limit", type=positive, metavar="N", help="look at the first N frames only (default: all)")
    parser.add_argument(
        "--decode",
        type=positive,
        default=200,
        metavar="N",
        help="decode at most N of them, evenly spread; stamps and encodings are looked at in all (default: 200)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE.png",
        help="write a picture: the CAD model from six sides with axes and scale, and the first, middle and last frame",
    )
    parser.set_defaults(command=_check)


def _check(arguments: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from hat_ros.bench.check import notes
    from hat_ros.errors import UsageError

    out: Path | None = arguments.out
    if out is not None and (out.suffix.lower() != ".png" or not out.parent.is_dir()):
        raise UsageError(f"--out {out}: name a file that ends in .png, in a folder that exists")
    lines: list[Line] = []
    try:
        with notes() as said:
            try:
                _look(arguments, lines, out)
            finally:
                lines += said
    finally:
        if lines:
            table = Table(title=Text(str(arguments.recording)), show_header=False)
            table.add_column(overflow="fold")
            table.add_column(overflow="fold")
            for label, text in lines:
                table.add_row(Text(label, "yellow" if label in ("warning", "refused") else ""), Text(text))
            Console().print(table)
    return 0


def _look(arguments: argparse.Namespace, lines: list[Line], out: Path | None) -> None:
    """Append what is found to the lines, so that what comes before an error is told too."""
    from hat_ros.bench import check
    from hat_ros.bench.check_frames import read_frames
    from hat_ros.bench.datasets.image_files import ImageRecording
    from hat_ros.errors import UsageError
    from hat_ros.io.bag_files import is_bag
    from hat_ros.segmentation.stage import SegmentationStage
    from hat_ros.target.loading import load_target

    path: Path = arguments.recording
    config = config_of(arguments)
    shown: list[UInt8] = []
    if path.is_file() and not is_bag(path):
        target = load_target(path, arguments.unit_scale)
        lines.extend(check.cad_lines(path, target, arguments.unit_scale))
    elif arguments.unit_scale != 1.0:
        raise UsageError("--unit-scale is for a CAD file alone: the target.yaml or labels.json of a recording says it")
    else:
        source = spec_of(arguments).open(config.camera)
        target, recording = source.target, source.recording
        for line in check.recording_lines(source):
            lines.append(line)
        # Other backends are networks: they take minutes, and weights.
        classical = config.segmentation.backend == "classical"
        segmentation = SegmentationStage(config, target) if classical else None
        found = read_frames(source, arguments.limit, arguments.decode, segmentation)
        for line in check.frame_lines(found, source):
            lines.append(line)
        scale = recording.unit_scale if isinstance(recording, ImageRecording) else 1.0
        if recording.target_path is not None:
            lines.extend(check.cad_lines(recording.target_path, target, scale))
        shown = found.shown
    if out is not None:
        from hat_ros.bench.check_picture import picture

        _write_picture(out, picture(target, shown))
        lines.append(("picture", str(out)))


def _write_picture(out: Path, rgb: UInt8) -> None:
    import cv2

    from hat_ros.errors import RunError

    try:
        out.write_bytes(cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes())
    except OSError as error:
        raise RunError(f"--out {out}: {error.strerror}: choose a place that can be written") from None
