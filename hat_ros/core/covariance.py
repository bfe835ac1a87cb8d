"""Covariance of the output from the residuals that the filter really sees."""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Float
from hat_ros.geometry import lie

# Effective number of residuals that the running means remember.
_MEMORY = 20
# Before the first residual: a coarse pose is good to about a tenth of a radian, and as much of its range.
_INITIAL_SIGMA_RAD = 0.1
_INITIAL_SIGMA_SHARE = 0.1


class ResidualCovariance:
    """Running second moments of measurement minus prediction, in the convention of ``Estimate.covariance``.

    At a measurement the covariance is the measurement's own if its source knows it, else that of the residuals; then it
    grows frame by frame as residuals have grown between measurements, like a random walk.
    """

    def __init__(self) -> None:
        self._n = 0
        self._residual = np.full((6, 6), np.nan)
        self._rate = np.full((6, 6), np.nan)
        self._at_measurement = np.full((6, 6), np.nan)
        self._frames_since = 0

    def update(
        self, T_cam_target: Float, measurement: Float | None, predicted: Float | None, covariance: Float | None
    ) -> Float:
        """Advance by one frame that has an output.

        Args:
            T_cam_target: (4, 4) the output.
            measurement: (4, 4) the frame's own measurement, None without one.
            predicted: (4, 4) prediction before that measurement, None without one.
            covariance: (6, 6) of the measurement if its source knows it.

        Returns:
            (6, 6) covariance of the output.
        """
        self._frames_since += 1
        if self._n == 0:
            sigma_m = _INITIAL_SIGMA_SHARE * float(np.linalg.norm(T_cam_target[:3, 3]))
            self._residual = np.diag(np.repeat([sigma_m**2, _INITIAL_SIGMA_RAD**2], 3))
            self._rate, self._n = self._residual.copy(), 1
        if measurement is not None:
            if predicted is not None:
                self._learn(measurement, predicted)
            self._at_measurement = self._residual if covariance is None else covariance
            self._frames_since = 0
        elif not np.isfinite(self._at_measurement).all():
            self._at_measurement = self._residual
        return self._at_measurement + self._frames_since * self._rate

    def _learn(self, measurement: Float, predicted: Float) -> None:
        turn = lie.so3_log(measurement[:3, :3] @ predicted[:3, :3].T)
        error = np.concatenate([measurement[:3, 3] - predicted[:3, 3], turn])
        square = np.outer(error, error)
        self._n = min(self._n + 1, _MEMORY)
        self._residual = self._residual + (square - self._residual) / self._n
        self._rate = self._rate + (square / self._frames_since - self._rate) / self._n
