"""How far to trust the predicted rotation of a track: a Kalman filter that reads its process noise off the images.

From some directions an outline tells little about a rotation: a cylinder about its axis, a plate about its normal. What
earlier images said must then last, as long as the prediction from frame to frame deserves it, and no longer: relative
motion may be exact to a tenth of a degree or, with the wrong relief, off by degrees at every frame. Its own sigma does
not tell these apart; the turns between what single images said do.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from hat_ros.array_types import Float
from hat_ros.geometry import lie

# Measured frames between which turns are compared; with fewer than the second nothing is known.
_HISTORY, _MIN_MEASURED = 14, 8
# Drifts of the prediction that are told apart, rad per frame; none is trusted more than the first.
_DRIFTS_RAD = np.radians(np.geomspace(0.25, 5.0, 24))
# Degrees of freedom of the heavy-tailed likelihood: one bad mask counts little.
_TAIL = 4.0
# The largest drift whose log-likelihood is short of the best by no more than this is assumed: trust has to be earned,
# and successive images err together.
_MARGIN = 8.0


class _Measured(NamedTuple):
    """What one image said, carried back to the track's first frame by the predictions: drift is what sets two apart.

    Attributes:
        number: of the frame.
        R: (3, 3) rotation.
        covariance: (3, 3) of its rotation vector, axes of the first frame.
    """

    number: int
    R: Float
    covariance: Float


class AttitudeFilter:
    """Covariance of a track's rotation vector, camera axes, rad^2.

    Args:
        start_sigma_rad: one sigma of a rotation, or of its drift per frame, of which nothing is known.
    """

    def __init__(self, start_sigma_rad: float) -> None:
        self._start_sigma_rad = start_sigma_rad
        self._start_information = start_sigma_rad**-2 * np.eye(3)
        self.forget()

    def forget(self) -> None:
        """A new track: nothing is known of its rotation, nor of its predictions."""
        self._covariance: Float | None = None
        self._information = self._start_information
        self._number = 0
        self._carried = np.eye(3)
        self._measured: deque[_Measured] = deque()
        # Of each with those before it, and all drifts; slots are taken in turn.
        self._log_likelihood = np.zeros((_HISTORY, _HISTORY, len(_DRIFTS_RAD)))
        self._slot = 0

    def predict(self, turn: Float) -> Float:
        """Advance by one frame with a predicted turn (3, 3): information (3, 3) about the rotation it leads to."""
        self._number += 1
        self._carried = turn @ self._carried
        self._information = self._start_information
        if self._covariance is not None:
            self._covariance = turn @ self._covariance @ turn.T + self.drift_rad() ** 2 * np.eye(3)
            self._information = self._information + np.linalg.inv(self._covariance)
        return self._information

    def correct(self, R_cam_target: Float, R_predicted: Float, covariance: Float) -> None:
        """Take in a measurement that was held to the prediction.

        Args:
            R_cam_target: (3, 3) the measured rotation.
            R_predicted: (3, 3) where :meth:`predict` led to.
            covariance: (3, 3) of what the image alone says.
        """
        innovation = lie.so3_log(R_cam_target @ R_predicted.T)
        # Where the image alone would have put it: the result balances both.
        alone = lie.so3_exp(innovation + covariance @ self._information @ innovation) @ R_predicted
        self._remember(alone, covariance)
        self._covariance = np.linalg.inv(self._information + np.linalg.inv(covariance))

    def restart(self, R_cam_target: Float, covariance: Float) -> None:
        """The track stands where an image alone has put it, with its (3, 3) covariance."""
        self._remember(R_cam_target, covariance)
        self._covariance = covariance

    def _remember(self, R_cam_target: Float, covariance: Float) -> None:
        back = self._carried.T
        newest = _Measured(self._number, back @ R_cam_target, back @ covariance @ back.T)
        if len(self._measured) == _HISTORY:
            self._measured.popleft()
        self._log_likelihood[self._slot] = self._log_likelihood[:, self._slot] = 0.0
        n = len(self._measured)
        if n:
            slots = (self._slot - np.arange(n, 0, -1)) % _HISTORY
            self._log_likelihood[self._slot, slots] = _log_likelihood(newest, self._measured)
        self._measured.append(newest)
        self._slot = (self._slot + 1) % _HISTORY

    def drift_rad(self) -> float:
        """Largest drift of the prediction, per frame and axis, that recent images make likely."""
        n = len(self._measured)
        if n < _MIN_MEASURED:
            return self._start_sigma_rad
        # Each measurement takes part in many pairs, and says only once what it says.
        log_likelihood = self._log_likelihood.sum(axis=(0, 1)) * (2.0 / (n - 1))
        return float(_DRIFTS_RAD[log_likelihood >= log_likelihood.max() - _MARGIN][-1])


def _log_likelihood(newest: _Measured, earlier: Iterable[_Measured]) -> Float:
    """Of the turns since each of n earlier measurements, for each drift: (n, drifts)."""
    number, R, covariance = (np.stack(column) for column in zip(*earlier, strict=True))
    values, axes = np.linalg.eigh(covariance + newest.covariance)
    along = np.einsum("nij,ni->nj", axes, lie.so3_log(newest.R @ R.transpose(0, 2, 1)))
    variance = values[:, None] + ((newest.number - number)[:, None] * _DRIFTS_RAD)[..., None] ** 2
    distance_sq = (along[:, None] ** 2 / variance).sum(axis=-1)
    return -0.5 * np.log(variance).sum(axis=-1) - 0.5 * (_TAIL + 3) * np.log1p(distance_sq / _TAIL)
