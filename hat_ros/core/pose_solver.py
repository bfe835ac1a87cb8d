"""The 6-DoF robust solve of Stage 4b, eqs. (fusionresiduals) and (causalfusion): one free pose, two measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hat_ros import lie
from hat_ros.types import Float

_MAX_STEPS = 100
_MAX_HALVINGS = 30
_STEP_TOLERANCE = 1e-13
# Central differences of the analytic gradient: truncation and rounding errors are both about 1e-10 here.
_DIFFERENCE = 1e-5
# The reweighted Gauss-Newton steps hand over to Newton steps when the gradient falls by less than this factor.
_SLOW = 0.1


@dataclass(frozen=True)
class PoseProblem:
    """An anchor and a prediction that pull at one pose.

    Attributes:
        anchor: (4, 4) M, the absolute measurement ``T_cam_target``.
        anchor_weight: multiplies its residual: g, times the confidence.
        predicted: (4, 4) relative motion applied to the previous output; E = predicted X^-1.
        relative_weight: w, multiplies the relative residual.
        lever_m_per_rad: lambda.
        huber_delta_m: delta of the componentwise Huber loss; None for the squared loss.
    """

    anchor: Float
    anchor_weight: float
    predicted: Float
    relative_weight: float
    lever_m_per_rad: float
    huber_delta_m: float | None

    def residuals(self, R: Float, t: Float) -> Float:
        """[g lambda Log(R_M R^T); g (t_M - t); w lambda Log(R_E); w t_E]: (n, 3, 3), (n, 3) -> (n, 12) metres."""
        R_T = np.swapaxes(R, -1, -2)
        R_E = self.predicted[:3, :3] @ R_T
        rotvecs = lie.so3_log(np.stack([self.anchor[:3, :3] @ R_T, R_E]))
        return np.concatenate(
            [
                self.anchor_weight * self.lever_m_per_rad * rotvecs[0],
                self.anchor_weight * (self.anchor[:3, 3] - t),
                self.relative_weight * self.lever_m_per_rad * rotvecs[1],
                self.relative_weight * (self.predicted[:3, 3] - (R_E @ t[..., None])[..., 0]),
            ],
            axis=-1,
        )

    def jacobians(self, R: Float, t: Float, residuals: Float) -> Float:
        """Derivative of the residuals by (delta, tau), R <- Exp(delta) R, t <- t + tau: (n, 12, 6)."""
        u, w = self.anchor_weight, self.relative_weight
        R_E = self.predicted[:3, :3] @ np.swapaxes(R, -1, -2)
        J = np.zeros((len(R), 12, 6))
        for first, weight in ((0, u), (6, w)):
            scale = weight * self.lever_m_per_rad
            J[:, first : first + 3, :3] = -scale * _right_jacobian_inverse(residuals[:, first : first + 3] / scale)
        J[:, 3:6, 3:] = -u * np.eye(3)
        J[:, 9:12, :3] = -w * (R_E @ lie.hat(t))
        J[:, 9:12, 3:] = -w * R_E
        return J

    def cost(self, residuals: Float) -> Float:
        """Sum of h_delta over the components: (n, 12) -> (n,)."""
        if self.huber_delta_m is None:
            return 0.5 * np.sum(residuals * residuals, axis=-1)
        inside = np.minimum(np.abs(residuals), self.huber_delta_m)
        return np.sum(inside * (np.abs(residuals) - 0.5 * inside), axis=-1)

    def influence(self, residuals: Float) -> Float:
        """Derivative of h_delta, componentwise."""
        if self.huber_delta_m is None:
            return residuals
        return np.clip(residuals, -self.huber_delta_m, self.huber_delta_m)

    def gradients(self, R: Float, t: Float) -> Float:
        """Gradient of the cost by (delta, tau): (n, 6)."""
        residuals = self.residuals(R, t)
        return np.einsum("nij,ni->nj", self.jacobians(R, t, residuals), self.influence(residuals))


def solve_pose(problem: PoseProblem) -> Float:
    """The minimum of eq. (causalfusion) that lies downhill of the prediction, to rounding precision: (4, 4).

    Reweighted Gauss-Newton steps (which converge at once where all residuals are small) come first; when they slow
    down, Newton steps with the Hessian's eigenvalues taken positive. No step may increase the cost.
    """
    R, t = problem.predicted[:3, :3], problem.predicted[:3, 3]
    newton, last_gradient = False, np.inf
    for _ in range(_MAX_STEPS):
        residuals = problem.residuals(R[None], t[None])
        J = problem.jacobians(R[None], t[None], residuals)[0]
        influence = problem.influence(residuals)[0]
        gradient = J.T @ influence
        size = float(np.abs(gradient).max())
        if size == 0.0:
            break
        newton = newton or size > _SLOW * last_gradient
        last_gradient = size
        hessian = _hessian(problem, R, t) if newton else _reweighted_hessian(J, residuals[0], influence)
        step = _descent_step(hessian, gradient)
        R, t, length = _walk_downhill(problem, R, t, step, float(problem.cost(residuals)[0]))
        if length < _STEP_TOLERANCE:
            break
    return lie.transform(R, t)


def _right_jacobian_inverse(rotvec: Float) -> Float:
    """J_r^-1 of SO(3) (Sola et al., eq. 144): (n, 3) -> (n, 3, 3)."""
    angle_sq = np.sum(rotvec * rotvec, axis=-1)
    small = angle_sq < 1e-6
    safe = np.where(small, 1.0, angle_sq)
    half = 0.5 * np.sqrt(safe)
    factor = np.where(small, 1.0 / 12.0 + angle_sq / 720.0, (1.0 - half / np.tan(half)) / safe)
    k = lie.hat(rotvec)
    return np.eye(3) + 0.5 * k + factor[..., None, None] * (k @ k)


def _reweighted_hessian(J: Float, residuals: Float, influence: Float) -> Float:
    weight = np.where(residuals == 0.0, 1.0, influence / np.where(residuals == 0.0, 1.0, residuals))
    return J.T @ (weight[:, None] * J)


def _hessian(problem: PoseProblem, R: Float, t: Float) -> Float:
    """Symmetrised central differences of the gradient: (6, 6)."""
    turns = lie.so3_exp(_DIFFERENCE * np.vstack([np.eye(3), -np.eye(3)])) @ R
    shifts = t + _DIFFERENCE * np.vstack([np.eye(3), -np.eye(3)])
    still_R, still_t = np.broadcast_to(R, (6, 3, 3)), np.broadcast_to(t, (6, 3))
    gradients = problem.gradients(np.concatenate([turns, still_R]), np.concatenate([still_t, shifts]))
    forward, backward = gradients[[0, 1, 2, 6, 7, 8]], gradients[[3, 4, 5, 9, 10, 11]]
    H = (forward - backward) / (2.0 * _DIFFERENCE)
    return 0.5 * (H + H.T)


def _descent_step(hessian: Float, gradient: Float) -> Float:
    values, vectors = np.linalg.eigh(hessian)
    values = np.maximum(np.abs(values), 1e-12 * np.abs(values).max())
    step = -vectors @ ((vectors.T @ gradient) / values)
    # Beyond half a radian the local model of a rotation says little.
    turn = float(np.linalg.norm(step[:3]))
    return step * min(1.0, 0.5 / turn) if turn > 0 else step


def _walk_downhill(problem: PoseProblem, R: Float, t: Float, step: Float, cost: float) -> tuple[Float, Float, float]:
    """Take the step, halved until the cost does not grow; stay when rounding hides any descent."""
    for _ in range(_MAX_HALVINGS):
        R_new, t_new = lie.so3_exp(step[:3]) @ R, t + step[3:]
        if problem.cost(problem.residuals(R_new[None], t_new[None]))[0] <= cost * (1.0 + 1e-15):
            return R_new, t_new, float(np.abs(step).max())
        step = 0.5 * step
    return R, t, 0.0
