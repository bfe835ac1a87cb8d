"""Errors of targets with symmetries: to the nearest of the poses that no image can tell apart.

MSSD and MSPD are the errors of the BOP challenge (Hodan et al., BOP Challenge 2020 on 6D Object Localization, ECCV 2020
workshops; functions ``mssd`` and ``mspd`` of its toolkit): the largest distance of a vertex, in space or in the image,
between the output and the nearest equal of the truth. Free turns are sampled as the toolkit does. Recalls are averaged
over its thresholds: 5 to 50 % of the diameter, and 5 to 50 pixels in an image 640 pixels wide.
"""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.evaluation.metrics import PoseErrors, pose_errors
from hat_ros.geometry.symmetry import Symmetry
from hat_ros.target.model import Target
from hat_ros.types import Camera

_MSSD_SHARES = np.arange(1, 11) * 0.05
_MSPD_PX, _MSPD_WIDTH_PX = np.arange(1, 11) * 5.0, 640


def nearest_truth(T_est: Float, T_true: Float, symmetry: Symmetry) -> Float:
    """Of the poses that look like the truth those nearest in rotation to the outputs; the truth where there is none.

    Args:
        T_est: (N, 4, 4) outputs, NaN where there is none.
        T_true: (N, 4, 4) ground truth, likewise.
        symmetry: of the target.

    Returns:
        (N, 4, 4).
    """
    both = _both(T_est, T_true)
    if symmetry.is_trivial or not len(both):
        return T_true
    nearest = T_true.copy()
    nearest[both] = symmetry.nearest(T_true[both], T_est[both, :3, :3])
    return nearest


def errors_to_nearest(T_est: Float, T_true: Float, symmetry: Symmetry) -> PoseErrors:
    """E_t, E_q and E_p to the nearest equal of the truth, arguments of :func:`nearest_truth`."""
    return pose_errors(T_est, nearest_truth(T_est, T_true, symmetry))


def mssd(T_est: Float, T_true: Float, target: Target, symmetry: Symmetry) -> Float:
    """Maximum symmetry-aware surface distance, metres: (N,), NaN where output or truth is missing.

    The vertex that is furthest off is one of the convex hull.
    """
    out = np.full(len(T_est), np.nan)
    for i in _both(T_est, T_true):
        off = T_est[i] - _equals(T_est[i], T_true[i], symmetry)
        distance = np.linalg.norm(target.hull_m @ np.swapaxes(off[:, :3, :3], -1, -2) + off[:, None, :3, 3], axis=-1)
        out[i] = distance.max(axis=1).min()
    return out


def mspd(T_est: Float, T_true: Float, target: Target, symmetry: Symmetry, camera: Camera) -> Float:
    """Maximum symmetry-aware projection distance, pixels: (N,), NaN where output or truth is missing.

    Infinite where a vertex is behind the camera.
    """
    out = np.full(len(T_est), np.nan)
    for i in _both(T_est, T_true):
        equals = _equals(T_est[i], T_true[i], symmetry)
        # Part of the vertices gives a lower bound: few equals have to be looked at with all of them.
        bounds = np.array([_off_px(T_est[i], T, target.hull_m, camera) for T in equals])
        best = np.inf
        for index in np.argsort(bounds, kind="stable"):
            if bounds[index] >= best:
                break
            best = min(best, _off_px(T_est[i], equals[index], target.vertices_m, camera))
        out[i] = best
    return out


def average_recalls(mssd_m: Float, mspd_px: Float, diameter_m: float, width_px: int, targets: int) -> dict[str, float]:
    """Shares of the targets within BOP's thresholds, averaged over these; a missing output is a miss.

    Args:
        mssd_m: (N,) MSSD. mspd_px: (N,) MSPD. diameter_m: of the target. width_px: of the image.
        targets: frames with a truth, those without an answer included.
    """
    if not targets:
        return {"AR_MSSD": float("nan"), "AR_MSPD": float("nan")}
    scaled_px = _MSPD_PX * width_px / _MSPD_WIDTH_PX
    within = {"AR_MSSD": mssd_m[:, None] < _MSSD_SHARES * diameter_m, "AR_MSPD": mspd_px[:, None] < scaled_px}
    return {name: float(flags.sum(axis=0).mean() / targets) for name, flags in within.items()}


def _both(T_est: Float, T_true: Float) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    return np.flatnonzero(np.isfinite(T_est).all(axis=(-1, -2)) & np.isfinite(T_true).all(axis=(-1, -2)))


def _equals(T_est: Float, T_true: Float, symmetry: Symmetry) -> Float:
    """(E, 4, 4) poses that look like the truth; of a ball's the nearest."""
    if len(symmetry.axes) > 1:
        return symmetry.nearest(T_true, T_est[:3, :3])[None]
    return T_true @ symmetry.sampled()


def _off_px(T_a: Float, T_b: Float, points_m: Float, camera: Camera) -> float:
    """Largest distance in the image between points (P, 3) at two poses."""
    a, b = (points_m @ T[:3, :3].T + T[:3, 3] for T in (T_a, T_b))
    if min(a[:, 2].min(), b[:, 2].min()) <= 0.0:
        return float("inf")
    return float(np.linalg.norm(camera.project(a) - camera.project(b), axis=1).max())
