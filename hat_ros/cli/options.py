"""Options and types that several commands share."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hat_ros.bench.source import SourceSpec
    from hat_ros.config import HatConfig

FORMATS = ("sequence", "spark", "shirt", "swisscube", "bop", "ycbv", "ycb_video", "speed")

Commands = Any  # argparse's sub-parser action has no public name


def add_config(parser: argparse.ArgumentParser) -> None:
    """``--config`` and ``--set``."""
    parser.add_argument(
        "--config",
        default="default",
        metavar="NAME|FILE",
        help="preset name or YAML file (default: default)",
    )
    add_overrides(parser)


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """``--set``."""
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="override one value, e.g. --set keyframes.gap_frames=4 (may be repeated)",
    )
    parser.add_argument(
        "--allow-unverified",
        dest="overrides",
        action="append_const",
        const="nets.allow_unverified=true",
        help="take network weights of another checksum than the published one",
    )


def add_camera(parser: argparse.ArgumentParser) -> None:
    """``--rectified`` and ``--image-depth``: what the messages of a camera do not say."""
    parser.add_argument(
        "--rectified",
        dest="overrides",
        action="append",
        type=_camera_word("rectified"),
        default=[],
        metavar="auto|true|false",
        help="which image camera_info describes: true: rectified, by P; false: raw, by K, and the distortion D is "
        "undone; auto: by the topic's name (default: auto)",
    )
    parser.add_argument(
        "--image-depth",
        dest="overrides",
        action="append",
        type=_camera_word("image_depth"),
        default=[],
        metavar="auto|8..16",
        help="significant bits of 16-bit images (default: auto)",
    )


def _camera_word(name: str) -> Callable[[str], str]:
    """A word that the parameter accepts, as its override."""

    def parse(text: str) -> str:
        from hat_ros.config import load_config
        from hat_ros.errors import ConfigError

        override = f"camera.{name}={text}"
        try:
            load_config("default", [override])
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
        return override

    return parse


def config_of(arguments: argparse.Namespace) -> HatConfig:
    """The configuration that ``--config`` and ``--set`` ask for."""
    from hat_ros.config import load_config

    return load_config(arguments.config, (*protocol_settings(arguments), *arguments.overrides))


def add_out(parser: argparse.ArgumentParser, what: str) -> None:
    """``--out`` and ``--overwrite``."""
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help=what)
    parser.add_argument("--overwrite", action="store_true", help="replace what an earlier run left in DIR")


class DefaultsFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Shows the default of every option that has one."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        return action.help if action.default in (None, False) else super()._get_help_string(action)


def add_dataset(parser: argparse.ArgumentParser, what: str = "the recording is a sequence") -> None:
    """``--dataset``, ``--model`` and ``--detections``; ``what`` is read from the data set."""
    parser.add_argument(
        "--dataset",
        choices=FORMATS,
        default="",
        metavar="FORMAT",
        help=f"{what} of a data set as published: {', '.join(FORMATS)}",
    )
    parser.add_argument("--model", type=Path, metavar="CAD", help="metric CAD model, for data sets that bring none")
    parser.add_argument(
        "--detections",
        type=Path,
        metavar="PATH",
        help="masks or boxes computed elsewhere, for --set segmentation.backend=annotated; see `hat import --help`",
    )


def add_protocol(parser: argparse.ArgumentParser, default: str) -> None:
    """``--protocol``: whether a data set is read and scored as the authors' benchmark does."""
    parser.add_argument(
        "--protocol",
        choices=("published", "none"),
        default=default,
        help="published: read and run the --dataset as the authors' benchmark does (split, regions, targets; see the "
        f"page Benchmark); --set overrides its settings (default: {default})",
    )


def protocol_settings(arguments: argparse.Namespace) -> tuple[str, ...]:
    """What the published protocol sets, ``key=value``; empty without one."""
    if getattr(arguments, "protocol", "none") == "none" or not arguments.dataset:
        return ()
    from hat_ros.bench.datasets.protocols import protocol_of

    return protocol_of(arguments.dataset).settings


def add_unit_scale(parser: argparse._ActionsContainer, whose: str) -> None:
    """``--unit-scale``; None for ``auto``."""
    parser.add_argument(
        "--unit-scale",
        type=_unit_scale,
        default=1.0,
        metavar="M|auto",
        help=f"metres per unit {whose}, auto guesses (default: 1, or what a target.yaml says)",
    )


def _unit_scale(text: str) -> float | None:
    """A number; None for ``auto``."""
    try:
        return None if text == "auto" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a number or auto, found '{text}'") from None


def add_topics(parser: argparse.ArgumentParser) -> None:
    """``--image-topic`` and ``--camera-info-topic``, where a bag is read."""
    parser.add_argument(
        "--image-topic",
        metavar="TOPIC",
        help="images of a bag with several cameras (default: /image, or the only one that is no depth image)",
    )
    parser.add_argument(
        "--camera-info-topic",
        metavar="TOPIC",
        help="calibration of these images (default: camera_info in the namespace of the images)",
    )


def spec_of(arguments: argparse.Namespace) -> SourceSpec:
    """The recording that a command's ``recording``, :func:`add_dataset` and ``--sequence`` name."""
    from hat_ros.bench.source import SourceSpec
    from hat_ros.errors import UsageError

    if bool(arguments.dataset) != bool(arguments.sequence):
        raise UsageError("--dataset and --sequence belong together: name the layout and one of its sequences")
    return SourceSpec(
        arguments.recording,
        arguments.dataset,
        arguments.sequence,
        arguments.model,
        arguments.detections,
        arguments.image_topic,
        arguments.camera_info_topic,
        getattr(arguments, "protocol", "none") == "published",
    )


def add_extent(parser: argparse.ArgumentParser) -> None:
    """``--start``, ``--limit``, and what not to write."""
    parser.add_argument("--start", type=natural, default=0, metavar="N", help="skip the first N frames (cold start)")
    parser.add_argument("--limit", type=positive, metavar="N", help="process at most N frames")
    parser.add_argument("--no-video", action="store_true", help="do not write the overlay video")
    parser.add_argument("--no-report", action="store_true", help="do not write report.html")
    parser.add_argument("--quiet", action="store_true", help="no progress bar, no table")


def extent_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """What :func:`add_extent` and :func:`add_out` say, as ``hat_ros.bench.runs.folder.RunOptions`` takes it."""
    return {
        "start": arguments.start,
        "limit": arguments.limit,
        "video": not arguments.no_video,
        "report": not arguments.no_report,
        "overwrite": arguments.overwrite,
    }


def add_threads(parser: argparse.ArgumentParser) -> None:
    """``--threads``."""
    parser.add_argument(
        "--threads",
        type=positive,
        metavar="N",
        help="threads of the numerical libraries (default: theirs)",
    )


def limit_threads(count: int | None) -> None:
    """Apply ``--threads``; effective only before the numerical libraries are imported."""
    if count is None:
        return
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = str(count)
    import cv2

    cv2.setNumThreads(count)


def positive(text: str) -> int:
    """An integer of at least 1."""
    value = natural(text)
    if value == 0:
        raise argparse.ArgumentTypeError(f"must be at least 1, found {text}")
    return value


def natural(text: str) -> int:
    """An integer of at least 0."""
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a whole number, found '{text}'") from None
    if value < 0:
        raise argparse.ArgumentTypeError(f"must not be negative, found {text}")
    return value
