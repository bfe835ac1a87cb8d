"""The result folder: written as ``NAME.partial``, renamed when complete; what a stopped run left stays readable.

bag/            result bag: all /hat topics except images, /target_pose, the truth if known
poses.tum       stamp x y z qx qy qz qw of every published T_cam_target
poses.csv       every admitted frame: stamp, state, pose, errors
frames.csv      every admitted frame: latency, time per stage (what the run measured)
masks.csv       frames with a recorded silhouette: overlap of the detected one with it
config.yaml     the configuration as used
run.json        where it came from: command, commit, versions, input hashes
metrics.json    figures: errors, coverage, speed
report.html     plots, overlay frames, table; one file, no network
overlay.mp4     the clip with the CAD outline drawn in
.hat_ros        says that the folder is ours and may be replaced
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import numpy as np
import yaml

from hat_ros.array_types import Float
from hat_ros.config import HatConfig, config_to_dict
from hat_ros.errors import UsageError
from hat_ros.io import own_folder
from hat_ros.types import Estimate

BAG_FOLDER = "bag"
METRICS_FILE = "metrics.json"
CONFIG_FILE = "config.yaml"
RUN_FILE = "run.json"


class ResultFolder:
    """A result folder under construction; a context manager.

    Leaving the ``with`` block normally renames ``NAME.partial`` to ``NAME``; leaving it by an exception keeps
    ``NAME.partial`` with everything written so far.

    Args:
        path: where the finished folder shall be.
        overwrite: replace a finished folder that is there already.

    Raises:
        UsageError: the folder exists and ``overwrite`` is false, it is no folder of ours, another command is writing
            there, or ``path`` is no place for a new folder.
        RunError: it cannot be created.
    """

    def __init__(self, path: str | Path, overwrite: bool = False) -> None:
        self.final_path = own_folder.checked_out(path)
        self.path = self.final_path.with_name(self.final_path.name + ".partial")
        self._stack = ExitStack()
        self._overwrite = overwrite
        self._check_replaceable()
        if self.path.exists():
            own_folder.require_ours(self.path)

    def _check_replaceable(self) -> None:
        if self.final_path.exists():
            if not self._overwrite:
                raise UsageError(f"--out {self.final_path} exists already: choose another folder or add --overwrite")
            own_folder.require_ours(self.final_path)

    @property
    def bag_path(self) -> Path:
        """Where the result bag goes."""
        return self.path / BAG_FOLDER

    def __enter__(self) -> ResultFolder:
        self._stack.enter_context(own_folder.NewFolder(self.path))  # what a run that was stopped left is replaced
        self._check_replaceable()  # another run may have finished since
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            if kind is None:
                own_folder.remove(self.final_path)
                self.path.rename(self.final_path)


def write_config(path: Path, config: HatConfig) -> None:
    """Write the configuration as used, complete."""
    text = yaml.safe_dump(config_to_dict(config), sort_keys=False)
    (path / CONFIG_FILE).write_text(text, encoding="utf-8")


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write strict JSON: NaN and infinities become null."""
    path.write_text(json.dumps(_plain(data), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_overlaps(path: Path, overlaps: Mapping[int, float]) -> None:
    """Write mask overlaps by stamp; nothing where there are none."""
    if overlaps:
        lines = [f"{stamp_ns},{overlap:.4f}\n" for stamp_ns, overlap in overlaps.items()]
        (path / "masks.csv").write_text("".join(("stamp_ns,iou\n", *lines)), encoding="utf-8")


class LiveTables:
    """Pose tables that grow with the run, flushed line by line, so that a stopped run leaves what it knew.

    Args:
        path: the result folder under construction.
        measured: names of the values per frame that go into ``frames.csv``.
    """

    def __init__(self, path: Path, measured: Sequence[str]) -> None:
        self._stack = ExitStack()
        self._tum = self._open(path / "poses.tum")
        self._frames = csv.writer(self._open(path / "frames.csv"), lineterminator="\n")
        self._frames.writerow(("stamp_ns", "state", *measured))

    def _open(self, path: Path) -> TextIO:
        return self._stack.enter_context(path.open("w", encoding="utf-8", buffering=1, newline=""))

    def add(self, estimate: Estimate, measured: Iterable[float]) -> None:
        """Append one frame."""
        if estimate.state.has_pose:
            self._tum.write(tum_line(estimate.stamp_ns, estimate.pose_row))
        cells = ("" if np.isnan(value) else f"{value:.4f}" for value in measured)
        self._frames.writerow((estimate.stamp_ns, estimate.state.name, *cells))

    def close(self) -> None:
        """Close the files."""
        self._stack.close()


def tum_line(stamp_ns: int, pose_row: Float) -> str:
    """One line of a TUM trajectory: seconds to the nanosecond, then the pose in full precision."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return f"{seconds}.{nanoseconds:09d} " + " ".join(repr(float(value)) for value in pose_row) + "\n"
