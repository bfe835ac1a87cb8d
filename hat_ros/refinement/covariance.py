"""Covariance of a refined pose from the residuals that its contour actually left.

The information matrix of the fit already carries the measured variance of mask and edge residuals. Two things make
the pose less certain than that: neighbouring contour points err together, and some errors are common to the whole
outline (a mask drawn a little large, an exposure that blooms, a CAD model that is not quite the target).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hat_ros.refinement.refiner import Fit

# Contour length over which residuals are taken to err together, pixels.
CORRELATION_PX = 8.0
# Error common to the whole outline, pixels.
COMMON_OFFSET_PX = 0.25


def pose_covariance(fit: Fit, radius_m: float) -> NDArray[np.float64] | None:
    """(6, 6) covariance of ``[dt (m); r (rad)]``; None when the contour leaves some direction without any evidence.

    Args:
        fit: the last fit.
        radius_m: bounding radius of the target, the unit of rotations.
    """
    scale = np.array([1.0, 1.0, 1.0, radius_m, radius_m, radius_m])
    H = _symmetric(fit.information) / np.outer(scale, scale)
    level = np.trace(H[:3, :3]) / 3.0
    if not np.isfinite(H).all() or level <= 0:
        return None
    # The same prior as the solver's damping, so that an unobservable direction is merely very uncertain.
    inverse = np.linalg.inv(H + 1e-4 * level * np.eye(6))
    covariance = CORRELATION_PX * inverse
    return covariance / np.outer(scale, scale)


def _symmetric(lower: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.tril(lower) + np.tril(lower, -1).T
