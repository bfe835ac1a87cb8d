"""All poses of a sequence at once: the joint optimisation of the offline Stage 4.

The residuals are those of eq. (fusionresiduals) with both ends of every relative motion free, and with one difference.
The shift of a step is taken where the target is, t_predicted - t, and not at the camera's origin, t_predicted - R_E t.
At zero lag that changes little. With both ends free, though, the latter lets a wrong SLAM scale be paid for by turning
the target about the camera, at the lever of its whole range, and poses bow between anchors: measured on a tumbling
target 10 m away, 2 degrees off halfway between anchors that are 0.3 degrees off.

Each pose meets only its neighbours, so the normal equations are banded and the cost of a step is linear in the number
of frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from hat_ros.array_types import Float
from hat_ros.config import FusionConfig
from hat_ros.geometry import lie

_MAX_STEPS = 100
_RELATIVE_TOLERANCE = 1e-12
# Beside its neighbours each 6-vector of unknowns reaches 11 rows below the diagonal.
_BANDWIDTH = 11


class PoseGraph:
    """Frames' poses; anchors pull at single ones, steps tie neighbours.

    Args:
        n_frames: N.
        fusion: weights and loss of the residuals.
        lever_m_per_rad: lambda.
    """

    def __init__(self, n_frames: int, fusion: FusionConfig, lever_m_per_rad: float) -> None:
        self._fusion, self._lever_m_per_rad = fusion, lever_m_per_rad
        self._start = np.full((n_frames, 4, 4), np.nan)
        self._anchors: dict[int, tuple[Float, float]] = {}
        self._steps: dict[int, Float] = {}

    def add_pose(self, frame: int, start: Float) -> None:
        """A free pose and where its search starts, (4, 4)."""
        self._start[frame] = start

    def add_anchor(self, frame: int, T_cam_target: Float, weight: float) -> None:
        """A measurement (4, 4) of a pose and what its residual is multiplied with."""
        self._anchors[frame] = (T_cam_target, weight)

    def add_step(self, frame: int, step: Float) -> None:
        """Relative motion (4, 4) that takes the pose of the frame before to this frame's."""
        self._steps[frame] = step

    def solve(self) -> Float:
        """Damped Gauss-Newton with Huber weights: (N, 4, 4), NaN at frames without any measurement."""
        frames = np.flatnonzero(np.isfinite(self._start[:, 0, 0]))
        if len(frames) == 0:
            return self._start
        terms = _Terms.build(frames, self._anchors, self._steps, self._fusion.relative_weight, self._lever_m_per_rad)
        delta = self._fusion.huber_delta_m if self._fusion.loss == "huber" else np.inf
        R, t = self._start[frames, :3, :3], self._start[frames, :3, 3]
        unary, binary = terms.residuals(R, t)
        cost, damping = _huber_cost(unary, binary, delta), 1e-6
        for _ in range(_MAX_STEPS):
            band, gradient = terms.normal_equations(R, t, unary, binary, delta)
            band[0] += damping * (1e-9 + band[0])
            step = scipy.linalg.solveh_banded(band, -gradient, lower=True).reshape(-1, 6)
            R_new, t_new = lie.so3_exp(step[:, :3]) @ R, t + step[:, 3:]
            unary_new, binary_new = terms.residuals(R_new, t_new)
            cost_new = _huber_cost(unary_new, binary_new, delta)
            if cost_new > cost:
                damping *= 10.0
                if damping > 1e12:
                    break
                continue
            gain = cost - cost_new
            R, t, unary, binary, cost = R_new, t_new, unary_new, binary_new, cost_new
            damping = max(damping * 0.1, 1e-12)
            if gain <= _RELATIVE_TOLERANCE * cost:
                break
        out = self._start.copy()
        out[frames] = lie.transform(R, t)
        return out


@dataclass(frozen=True)
class _Terms:
    """The residuals in arrays: anchors of nodes ``anchor_node``, steps into nodes ``step_node`` from the one before."""

    n_nodes: int
    anchor_node: NDArray[np.intp]
    anchor: Float
    anchor_weight: Float
    step_node: NDArray[np.intp]
    step: Float
    step_weight: float
    lever_m_per_rad: float

    @classmethod
    def build(
        cls,
        frames: NDArray[np.intp],
        anchors: dict[int, tuple[Float, float]],
        steps: dict[int, Float],
        step_weight: float,
        lever_m_per_rad: float,
    ) -> _Terms:
        node = {int(frame): i for i, frame in enumerate(frames)}
        return cls(
            len(frames),
            np.array([node[frame] for frame in anchors], dtype=np.intp),
            np.array([pose for pose, _ in anchors.values()]).reshape(-1, 4, 4),
            np.array([weight for _, weight in anchors.values()]),
            np.array([node[frame] for frame in steps], dtype=np.intp),
            np.array(list(steps.values())).reshape(-1, 4, 4),
            step_weight,
            lever_m_per_rad,
        )

    def residuals(self, R: Float, t: Float) -> tuple[Float, Float]:
        """Anchor (A, 6) and step (B, 6) residuals in metres, rotation first."""
        a, b, lever = self.anchor_node, self.step_node, self.lever_m_per_rad
        turn = lever * lie.so3_log(self.anchor[:, :3, :3] @ np.swapaxes(R[a], 1, 2))
        unary = np.concatenate([turn, self.anchor[:, :3, 3] - t[a]], axis=1) * self.anchor_weight[:, None]
        dR = self.step[:, :3, :3]
        turn = lever * lie.so3_log(dR @ R[b - 1] @ np.swapaxes(R[b], 1, 2))
        shift = np.einsum("nij,nj->ni", dR, t[b - 1]) + self.step[:, :3, 3] - t[b]
        return unary, self.step_weight * np.concatenate([turn, shift], axis=1)

    def normal_equations(self, R: Float, t: Float, unary: Float, binary: Float, delta: float) -> tuple[Float, Float]:
        """Reweighted Gauss-Newton system: lower band (12, 6 n) and gradient (6 n,)."""
        n = self.n_nodes
        diagonal, below, gradient = np.zeros((n, 6, 6)), np.zeros((n, 6, 6)), np.zeros((n, 6))
        a, b, w, lever = self.anchor_node, self.step_node, self.step_weight, self.lever_m_per_rad
        J = np.zeros((len(a), 6, 6))
        scale = self.anchor_weight[:, None, None]
        J[:, :3, :3] = (
            -lever * scale * lie.so3_right_jacobian_inverse(_divided(unary[:, :3], lever * self.anchor_weight))
        )
        J[:, 3:, 3:] = -scale * np.eye(3)
        _accumulate(diagonal, gradient, a, J, unary, delta)

        dR = self.step[:, :3, :3]
        inverse = lie.so3_right_jacobian_inverse(_divided(binary[:, :3], np.full(len(b), w * lever)))
        J_now, J_before = np.zeros((len(b), 6, 6)), np.zeros((len(b), 6, 6))
        J_now[:, :3, :3] = -w * lever * inverse
        J_now[:, 3:, 3:] = -w * np.eye(3)
        # The left Jacobian's inverse is the transpose of the right one's.
        J_before[:, :3, :3] = w * lever * np.swapaxes(inverse, 1, 2) @ dR
        J_before[:, 3:, 3:] = w * dR
        _accumulate(diagonal, gradient, b, J_now, binary, delta)
        _accumulate(diagonal, gradient, b - 1, J_before, binary, delta)
        weighted = _huber_weights(binary, delta)[:, :, None] * J_before
        np.add.at(below, b, np.swapaxes(J_now, 1, 2) @ weighted)

        band = np.zeros((_BANDWIDTH + 1, 6 * n))
        for row in range(6):
            for column in range(6):
                if row >= column:
                    band[row - column, column::6] = diagonal[:, row, column]
                band[row + 6 - column, column : 6 * (n - 1) : 6] = below[1:, row, column]
        return band, gradient.ravel()


def _accumulate(
    diagonal: Float, gradient: Float, nodes: NDArray[np.intp], J: Float, residuals: Float, delta: float
) -> None:
    weights = _huber_weights(residuals, delta)
    J_T = np.swapaxes(J, 1, 2)
    np.add.at(diagonal, nodes, J_T @ (weights[:, :, None] * J))
    np.add.at(gradient, nodes, (J_T @ (weights * residuals)[:, :, None])[:, :, 0])


def _huber_weights(residuals: Float, delta: float) -> Float:
    return np.minimum(1.0, delta / np.maximum(np.abs(residuals), 1e-300))


def _huber_cost(unary: Float, binary: Float, delta: float) -> float:
    size = np.abs(np.concatenate([unary, binary]))
    inside = np.minimum(size, delta)
    return float(np.sum(inside * (size - 0.5 * inside)))


def _divided(rows: Float, scales: Float) -> Float:
    """Rows by scales, zero where a scale is zero."""
    return rows / np.where(scales == 0.0, 1.0, scales)[:, None]
