"""Covariance of a refined pose from the residuals that its contour actually left.

The information matrix of the fit carries the measured variance of mask and edge residuals, counts a stretch of contour
as one sample, and holds the errors common to the whole outline as two more unknowns, which are marginalised here.
"""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Float
from hat_ros.refinement.mask_field import Overlap
from hat_ros.refinement.pose_fitter import Fit

# Systematic error of an outline: a threshold at half level, a glow or a fillet each move it by part of a pixel.
OUTLINE_SIGMA_PX = 0.25
# Mean distance of the outlines that pixels and blur leave between a good mask and the right pose.
USUAL_MISFIT_PX = 0.5
# Uncertainty of a direction without any evidence, in units of the mean: large but finite.
_WEAKEST = 1e-4


def outline_misfit_px(areas: Overlap, outline_px: float) -> float:
    """Mean distance between the outlines of silhouette and mask, in excess of what a good mask shows; pixels.

    Args:
        areas: agreement and disagreement of the two. What is hidden in the dark is no disagreement.
        outline_px: length of the silhouette's outline.
    """
    return max((areas.extra + areas.missing) / max(outline_px, 1.0) - USUAL_MISFIT_PX, 0.0)


def outline_floor(T_cam_target: Float, focal_px: float, radius_m: float) -> Float:
    """(6, 6) what exposure, blur and the CAD model do to an outline, which no residual of one image shows.

    An outline that is some pixels too wide all around is a depth error of that share of the target's apparent radius;
    shifted by as much it is a lateral error, twisted a rotation.

    Args:
        T_cam_target: (4, 4) pose. focal_px: focal length. radius_m: bounding radius of the target.
    """
    position = T_cam_target[:3, 3]
    range_m = float(np.linalg.norm(position))
    lateral_m = OUTLINE_SIGMA_PX * range_m / focal_px
    depth_m = lateral_m * range_m / radius_m
    sight = position / range_m
    floor = np.zeros((6, 6))
    floor[:3, :3] = lateral_m**2 * np.eye(3) + depth_m**2 * np.outer(sight, sight)
    floor[3:, 3:] = (lateral_m / radius_m) ** 2 * np.eye(3)
    return floor


def pose_covariance(fit: Fit, radius_m: float) -> Float | None:
    """(6, 6) covariance of ``[dt (m); r (rad)]``; None when nothing was measured.

    Args:
        fit: the last fit.
        radius_m: bounding radius of the target, the unit of rotations.
    """
    scale = np.array([1.0, 1.0, 1.0, radius_m, radius_m, radius_m, 1.0, 1.0])
    H = _symmetric(fit.information) / np.outer(scale, scale)
    level = np.trace(H[:3, :3]) / 3.0
    if not np.isfinite(H).all() or level <= 0:
        return None
    H[:6, :6] += _WEAKEST * level * np.eye(6)
    covariance = np.linalg.inv(H)[:6, :6]
    return covariance / np.outer(scale[:6], scale[:6])


def _symmetric(lower: Float) -> Float:
    return np.tril(lower) + np.tril(lower, -1).T
