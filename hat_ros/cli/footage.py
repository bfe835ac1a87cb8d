"""``hat import video`` and ``hat import images``: the options that data sets do not have."""

from __future__ import annotations

import argparse
from pathlib import Path

from hat_ros.cli.options import add_unit_scale

FOOTAGE = ("video", "images")


def add_footage(parser: argparse.ArgumentParser) -> None:
    """The options of a film or a folder of images."""
    group = parser.add_argument_group("video and images")
    group.add_argument(
        "--K", dest="intrinsics", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"), help="intrinsics, px"
    )
    group.add_argument(
        "--camera", type=Path, metavar="YAML", help="calibration of ROS' camera_calibration, or a CameraInfo as YAML"
    )
    group.add_argument(
        "--rectified", action="store_true", help="the images are rectified: projection_matrix describes them"
    )
    group.add_argument(
        "--fps", type=float, metavar="HZ", help="images per second (default: the film's, 10 of a folder)"
    )
    add_unit_scale(group, "of the CAD file")


def import_footage(arguments: argparse.Namespace) -> int:
    """Write the bag."""
    from hat_ros.bench.datasets.footage import Footage
    from hat_ros.bench.datasets.footage import import_footage as write_bag
    from hat_ros.cli.console import count_progress
    from hat_ros.errors import UsageError

    for name in ("sequence", "boxes", "detections", "instance", "check"):
        if getattr(arguments, name) not in (None, False, []):
            raise UsageError(f"import {arguments.format}: --{name} is for data sets")
    if arguments.model is None:
        raise UsageError(f"import {arguments.format}: name the CAD model with --model")
    footage = Footage(
        arguments.format,
        arguments.source,
        arguments.model,
        arguments.intrinsics,
        arguments.camera,
        arguments.rectified,
        arguments.fps,
        arguments.unit_scale,
    )
    with count_progress(arguments.quiet) as watch:
        print(write_bag(footage, arguments.out, watch))
    return 0


def refuse_footage_options(arguments: argparse.Namespace) -> None:
    """A data set brings its calibration.

    Raises:
        UsageError: one of the options is given all the same.
    """
    from hat_ros.errors import UsageError

    given = {
        "--K": arguments.intrinsics,
        "--camera": arguments.camera,
        "--rectified": arguments.rectified,
        "--fps": arguments.fps,
        "--unit-scale": arguments.unit_scale != 1.0,
    }
    for name, value in given.items():
        if value:
            raise UsageError(f"import {arguments.format}: {name} is for `hat import video` and `hat import images`")
