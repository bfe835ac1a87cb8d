"""Recorded observations: what the front ends saw of a sequence, as arrays in an ``.npz`` file.

Front ends are expensive and temporal settings are not: with the candidates and SLAM poses of a sequence on disk,
``hat temporal`` runs Stages 3 and 4 alone. ``hat track --mode observe`` records them.
"""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hat_ros.array_types import Bool, Float
from hat_ros.core.guard import candidates_from_recording, guard_candidates
from hat_ros.core.selector import box_area_px
from hat_ros.errors import CandidateError, InputError
from hat_ros.geometry import lie
from hat_ros.io.run_log import RunLog
from hat_ros.types import Candidates, Motion

MAX_UNPACKED_BYTES = 4 << 30

_HALF_TURN = np.diag([1.0, -1.0, -1.0])
# Far below any score of an estimator.
_PADDING_SCORE = 1e6


@dataclass(frozen=True)
class Observations:
    """What the front ends said about N frames.

    Attributes:
        slam: (N, 4, 4) ``T_slam_cam``, all NaN where there is no motion.
        key: (N,) bool, anchor opportunities that were taken.
        poses: (N, K, 4, 4) candidates ``T_cam_target``; read only where ``key``.
        scores: (N, K) their appearance scores, in the estimator's own order.
        box_area_px: (N,) area of the detection box in square pixels, NaN where unknown; None if not recorded.

    Raises:
        InputError: an array is missing its shape or type, K or N is zero, or a SLAM pose is neither NaN nor rigid.
    """

    slam: Float
    key: Bool
    poses: Float
    scores: Float
    box_area_px: Float | None = None

    def __post_init__(self) -> None:
        n = len(self.key) if np.ndim(self.key) == 1 else -1
        _require(n >= 1, "key", f"shape (N,) with N >= 1, found shape {np.shape(self.key)}")
        _require(self.key.dtype == np.bool_, "key", f"dtype bool, found {self.key.dtype}")
        k = self.poses.shape[1] if np.ndim(self.poses) == 4 else -1
        shapes = {"slam": (n, 4, 4), "poses": (n, k, 4, 4), "scores": (n, k)}
        if self.box_area_px is not None:
            shapes["box_area_px"] = (n,)
        for name, shape in shapes.items():
            array = getattr(self, name)
            expected = str(shape).replace("-1", "K")
            _require(array.shape == shape, name, f"shape {expected} to match key, found {array.shape}")
            _require(array.dtype.kind == "f", name, f"a floating-point dtype, found {array.dtype}")
            object.__setattr__(self, name, np.asarray(array, dtype=np.float64))
        _require(k >= 1, "poses", "at least one candidate per frame (K >= 1), found K = 0")
        wrong = np.flatnonzero(~(lie.is_rigid(self.slam) | np.isnan(self.slam).all(axis=(1, 2))))
        if len(wrong):
            raise InputError(
                f"slam: frame {wrong[0]} is neither rigid nor all NaN; give T_slam_cam, or NaN for no motion"
            )
        if self.box_area_px is not None and (np.isinf(self.box_area_px).any() or (self.box_area_px < 0).any()):
            raise InputError("box_area_px: must be zero or more, or NaN where unknown")

    def __len__(self) -> int:
        return len(self.key)

    def motion(self, frame: int) -> Motion:
        """Stage 4's and 3's view of one frame's SLAM pose."""
        if np.isnan(self.slam[frame, 0, 0]):
            return Motion.none()
        return Motion(True, 0, lie.row_from_matrix(self.slam[frame]))

    def candidates(self, frame: int, drop: bool) -> Candidates:
        """Guarded candidates of one frame, in the order recorded; none where there was no opportunity.

        Raises:
            CandidateError: ``drop`` is False and a candidate is not finite or not rigid.
        """
        if not self.key[frame]:
            return Candidates.none()
        area_px = np.nan if self.box_area_px is None else self.box_area_px[frame]
        # Only the area of the box is recorded, and only its area is used.
        box_xyxy = np.array([0.0, 0.0, area_px, 1.0])
        recorded = candidates_from_recording(self.poses[frame], self.scores[frame], box_xyxy)
        try:
            return guard_candidates(recorded, drop)
        except CandidateError as error:
            raise CandidateError(f"frame {frame}, {error}") from None


def load_observations(path: str | os.PathLike[str]) -> Observations:
    """Read an ``.npz`` file with the arrays of :class:`Observations`; further arrays in it are not read.

    Raises:
        InputError: no such file, not an npz archive, an array missing or malformed.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected an .npz with slam, key, poses and scores")
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked_bytes = sum(item.file_size for item in archive.infolist())
        if unpacked_bytes > MAX_UNPACKED_BYTES:
            raise InputError(
                f"{path}: unpacks to {unpacked_bytes >> 20} MiB, more than the {MAX_UNPACKED_BYTES >> 20} "
                f"MiB accepted; split the recording"
            )
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in ("slam", "key", "poses", "scores", "box_area_px") if name in data}
    except (OSError, EOFError, ValueError, zipfile.BadZipFile, zipfile.LargeZipFile) as error:
        raise InputError(f"{path}: not a readable .npz of plain arrays ({' '.join(str(error).split())})") from None
    missing = [name for name in ("slam", "key", "poses", "scores") if name not in arrays]
    if missing:
        raise InputError(f"{path}: array '{missing[0]}' is missing; expected slam, key, poses, scores [, box_area_px]")
    try:
        return Observations(**arrays)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def observations_of(log: RunLog) -> Observations:
    """The same observations in the form that ``hat temporal`` reads.

    That form has one SLAM gauge and the same K everywhere. So only the longest SLAM epoch keeps its motion, and
    frames with fewer candidates are filled up with ones that can neither win nor support another: turned away from
    the best one by 180 degrees, with a score far below all others.
    """
    k = max((len(group) for group in log.candidates), default=1) or 1
    poses = np.tile(np.eye(4), (len(log), k, 1, 1))
    scores = np.zeros((len(log), k))
    area_px = np.full(len(log), np.nan)
    for i, group in enumerate(log.candidates):
        if len(group):
            area_px[i] = box_area_px(group.box_xyxy)
            poses[i] = group.T_cam_target[0] @ lie.transform(_HALF_TURN, np.zeros(3))
            scores[i] = group.log_score.min() - _PADDING_SCORE
            poses[i, : len(group)], scores[i, : len(group)] = group.T_cam_target, group.log_score
    epochs, counts = np.unique(log.slam_epoch[log.motion_valid], return_counts=True)
    longest = epochs[np.argmax(counts)] if len(epochs) else -1
    usable = log.motion_valid & (log.slam_epoch == longest)
    slam = np.full((len(log), 4, 4), np.nan)
    slam[usable] = lie.matrix_from_row(log.motion_rows[usable])
    return Observations(slam, np.array([len(group) > 0 for group in log.candidates]), poses, scores, area_px)


def save_observations(path: Path, log: RunLog) -> None:
    """Write :func:`observations_of` as an ``.npz`` file."""
    with path.open("wb") as file:
        np.savez_compressed(file, **vars(observations_of(log)))


def _require(holds: bool, name: str, expectation: str) -> None:
    if not holds:
        raise InputError(f"{name}: expected {expectation}")
