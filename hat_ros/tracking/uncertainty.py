"""What keyframes and masks say about the uncertainty of an output beside its residuals."""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Float
from hat_ros.geometry import lie
from hat_ros.types import Selection

# Keyframes whose spread counts. So few tell a variance badly: Student's t with as many degrees of freedom reaches, at
# 95 %, as far as a normal distribution of so many times the variance.
_KEYFRAMES, _FEW = 4, 2.0


def widened(covariance: Float, misfit_px: float, basin: Float) -> Float:
    """Covariance (6, 6) of a measurement whose outline and mask disagree.

    Where a mask lacks parts, the robust fit follows what is left of it, wherever that lies, with small residuals: a
    pixel of misfit doubles the variance that they show, but never beyond what a refinement can be off within its basin.

    Args:
        covariance: (6, 6) of what residuals show.
        misfit_px: see ``Refined.misfit_px``.
        basin: (6,) sigmas that bound it, in the same units.
    """
    information = np.linalg.inv((1.0 + misfit_px**2) * covariance)
    return np.linalg.inv(information + np.diag(basin**-2.0)) if misfit_px > 0.0 else covariance


class KeyframeSpread:
    """Second moments of the hypotheses in the output's basin about the output, over the last keyframes.

    One image's residuals know nothing of what they have in common: a mask without its dark parts, an outline that looks
    alike from directions far apart (a cylinder about its axis). Hypotheses found apart from the track show it: where
    image and model tell little, they scatter, and most in the direction of which least is known.

    Args:
        apart_deg: orientations further apart than this are different basins.
    """

    def __init__(self, apart_deg: float) -> None:
        self._apart_rad = np.radians(apart_deg)
        self._n = 0
        self._mean = np.zeros((6, 6))

    def update(self, selection: Selection, T_cam_target: Float) -> Float:
        """Take in one frame, keyframe or not: its candidates, and its output (4, 4).

        Candidates count as the decoder's path scores say, which are log-likelihoods.

        Returns:
            (6, 6) to add to the covariance of the output, in its convention; zero before the first keyframe.
        """
        square = self._second_moment(selection, T_cam_target)
        if square is not None:
            self._n = min(self._n + 1, _KEYFRAMES)
            self._mean = self._mean + (square - self._mean) / self._n
        return _FEW * self._mean

    def _second_moment(self, selection: Selection, T_cam_target: Float) -> Float | None:
        """(6, 6) of one keyframe; None where no candidate stands in the output's basin."""
        T = selection.candidates.T_cam_target
        apart_rad = lie.angle_between(T[:, :3, :3], T_cam_target[:3, :3])
        near = np.isfinite(selection.path_score) & (apart_rad <= self._apart_rad)
        if not near.any():
            return None
        path_score = selection.path_score[near]
        weight = np.exp(path_score - path_score.max())
        turn = lie.so3_log(T[near, :3, :3] @ T_cam_target[:3, :3].T)
        error = np.concatenate([T[near, :3, 3] - T_cam_target[:3, 3], turn], axis=1)
        return (weight[:, None] * error).T @ error / weight.sum()
