"""A run made by hand: known truth, known errors, every state; so that tests need no backend and no second."""

from __future__ import annotations

import numpy as np

from hat_ros.geometry import lie
from hat_ros.tracker import Step
from hat_ros.types import Alignment, Camera, Candidates, Detection, Estimate, Frame, Motion, Selection, TrackState

CAMERA = Camera(np.array([[100.0, 0, 31.5], [0, 100.0, 23.5], [0, 0, 1]]), 64, 48)
FIRST_NS, STEP_NS = 1_000_000_000, 100_000_000


def stamp(index: int) -> int:
    return FIRST_NS + index * STEP_NS


def true_row(index: int) -> np.ndarray:
    T = lie.transform(lie.so3_exp(np.radians([3.0 * index, 10.0, -5.0])), np.array([0.1, -0.1, 5.0 + 0.1 * index]))
    return lie.row_from_matrix(T)


def turned(row: np.ndarray, degrees: float, dz: float = 0.0) -> np.ndarray:
    T = lie.matrix_from_row(row)
    R = lie.so3_exp(np.radians([0.0, 0.0, degrees]))
    return lie.row_from_matrix(lie.transform(R @ T[:3, :3], T[:3, 3] + [0, 0, dz]))


def frame(index: int, given_mask: np.ndarray | None = None) -> Frame:
    return Frame(stamp(index), np.full((48, 64, 3), index % 256, np.uint8), CAMERA, given_mask)


def mask() -> np.ndarray:
    out = np.zeros((48, 64), bool)
    out[10:30, 20:44] = True
    return out


class ScriptedMethod:
    """Errors of one degree per frame; starts without a pose, coasts at frame 6, is lost from frame 8 on."""

    causal = True
    concurrent = False

    def __init__(self) -> None:
        self.seen: list[Frame] = []

    def step(self, seen: Frame) -> Step:
        self.seen.append(seen)
        index = (seen.stamp_ns - FIRST_NS) // STEP_NS
        state = {0: TrackState.UNINITIALISED, 6: TrackState.COASTING}.get(index, TrackState.TRACKING)
        state = TrackState.LOST if index >= 8 else state
        has_pose = state.has_pose
        keyframe = index % 4 == 0
        candidates = Candidates.none()
        if keyframe:
            rows = np.array([turned(true_row(index), 170.0), turned(true_row(index), 2.0)])
            candidates = Candidates(rows, np.array([1.0, 0.5]), np.array([19.5, 9.5, 43.5, 29.5]))
        selected = 1 if keyframe else -1
        selection = Selection(candidates, candidates.log_score, candidates.log_score - 1.0, selected)
        motion_row = lie.row_from_matrix(lie.inverse(lie.matrix_from_row(true_row(index))))
        estimate = Estimate(
            seen.stamp_ns,
            state,
            turned(true_row(index), float(index), 0.05) if has_pose else np.full(7, np.nan),
            np.eye(6) * 0.01 if has_pose else np.full((6, 6), np.nan),
            keyframe=keyframe,
            n_candidates=len(candidates),
            anchor=selected,
            gate_weight=1.0 if keyframe else float("nan"),
            alignment=Alignment(1, 2.0, np.array([0.0, 0, 0, 1]), np.zeros(3), 3, 0.1, 0) if index >= 2 else None,
            gap_frames=index % 4,
        )
        return Step(Detection(mask()), candidates, Motion(True, 0, motion_row, 3), selection, estimate)

    def finish(self) -> list[Estimate]:
        return []


def steps(count: int = 10) -> list[Step]:
    method = ScriptedMethod()
    return [method.step(frame(index)) for index in range(count)]


def truth(count: int = 10) -> dict[int, np.ndarray]:
    return {stamp(index): true_row(index) for index in range(count)}
