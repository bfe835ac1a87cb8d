"""Stages 3 and 4 alone over recorded observations: what ``hat temporal`` runs.

Front ends are expensive and temporal settings are not: with the candidates and SLAM poses of a sequence on disk, a
sweep needs only this. The stages are the very objects of the tracker, without a refiner (there are no images).
"""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hat_ros.array_types import Bool, Float, Int
from hat_ros.bench.methods.smoothing import solve_offline
from hat_ros.config import HatConfig
from hat_ros.core.fusion import FusionStage
from hat_ros.core.guard import candidates_from_recording, guard_candidates
from hat_ros.core.published_fusion import PublishedFusion
from hat_ros.core.selector import SelectorStage
from hat_ros.errors import CandidateError, InputError
from hat_ros.geometry import lie
from hat_ros.types import Camera, Candidates, Frame, Motion, TrackState

MAX_UNPACKED_BYTES = 4 << 30


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


@dataclass(frozen=True)
class TemporalResult:
    """The causal answer for N frames.

    Attributes:
        T_cam_target: (N, 4, 4) output, NaN before the first; the last valid pose where ``held``.
        chosen: (N,) int, index of the anchor among the recorded candidates, -1 where there is none.
        accepted: (N,) bool, the decoder's own proposal became the anchor: warm-up over, running gate open.
        resets: (M,) int, frames at which the alignment was dropped.
        held: (N,) bool, no output was possible and the last one (or its gap-filled successor) stands in.
    """

    T_cam_target: Float
    chosen: Int
    accepted: Bool
    resets: Int
    held: Bool


def run_temporal(observations: Observations, config: HatConfig) -> TemporalResult:
    """Run Stages 3 and 4 over recorded observations.

    A pose is given for every frame after the first anchor, however long ago it was: being LOST is a matter for those
    who act on poses, not for comparing them.

    Raises:
        CandidateError: a candidate at a keyframe is malformed and ``hypotheses.guard`` is off.
    """
    n = len(observations)
    config = replace(config, fusion=replace(config.fusion, coast_limit_frames=n))
    selector, fusion = SelectorStage(config.selector), FusionStage(config, PublishedFusion(config))
    T_cam_target, held = np.full((n, 4, 4), np.nan), np.zeros(n, dtype=bool)
    chosen, accepted, n_resets = np.full(n, -1), np.zeros(n, dtype=bool), np.zeros(n + 1, dtype=int)
    for t in range(n):
        motion = observations.motion(t)
        selection = selector.update(observations.candidates(t, config.hypotheses.guard), motion)
        estimate = fusion.update(_imageless_frame(t), None, motion, selection)
        if estimate.state.has_pose:
            T_cam_target[t], held[t] = estimate.T_cam_target, estimate.state == TrackState.COASTING
        chosen[t], accepted[t], n_resets[t + 1] = selection.selected, selector.accepted, estimate.n_resets
    return TemporalResult(T_cam_target, chosen, accepted, np.flatnonzero(np.diff(n_resets)), held)


def run_offline(observations: Observations, config: HatConfig) -> TemporalResult:
    """The whole-clip solution of the same observations, not causal (:mod:`hat_ros.bench.methods.smoothing`).

    ``accepted`` marks the anchors that counted; there are no resets, and nothing is said to be held.

    Raises:
        CandidateError: as in :func:`run_temporal`.
    """
    n = len(observations)
    candidates = [observations.candidates(t, config.hypotheses.guard) for t in range(n)]
    result = solve_offline(candidates, [observations.motion(t) for t in range(n)], config)
    accepted = result.gate_weight == 1.0
    no_resets, not_held = np.zeros(0, dtype=np.int64), np.zeros(n, dtype=bool)
    return TemporalResult(result.T_cam_target, result.chosen, accepted, no_resets, not_held)


def _imageless_frame(index: int) -> Frame:
    """A frame of which only the stamp is ever read."""
    return Frame(index + 1, np.zeros((1, 1, 3), dtype=np.uint8), Camera(np.eye(3), 1, 1))


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


def save_result(path: str | os.PathLike[str], result: TemporalResult) -> None:
    """Write the result as ``.npz``, whole or not at all.

    Raises:
        InputError: the folder does not exist or cannot be written.
    """
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            np.savez(file, **vars(result))
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


def _require(holds: bool, name: str, expectation: str) -> None:
    if not holds:
        raise InputError(f"{name}: expected {expectation}")
