"""The view bank of a CAD model: what its silhouette looks like from everywhere, in a form that is cheap to compare.

Each view keeps its silhouette on a polar grid about its own centroid, scaled by its radius of gyration and Fourier
transformed over the polar angle, so that turning the camera about its axis is a multiplication by a phase; and a
sparse set of contour points in 3-D, from which a pose can be refined without rendering. Built once per model in about
two seconds and kept in the platform's cache folder.

Booms and antennas can be left out of both sides of the comparison. They have much outline and little area; before a
black sky they show, before anything else a mask hardly ever has them, and then contour points on them would drag a pose
towards a part of the mask that they do not belong to.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import Bool, Float, Float32
from hat_ros.cache import cached_arrays
from hat_ros.target.contour import COL_WEIGHT, contour_table
from hat_ros.target.masks import mask_moments
from hat_ros.target.model import Target
from hat_ros.target.polar import MAX_RADIUS, N_RINGS, polar_grid, ring_weights
from hat_ros.target.rendering import Renderer
from hat_ros.target.sphere import look_inwards
from hat_ros.types import Camera

# Raised whenever the content of a bank changes its meaning: older cache files are then not found.
_FORMAT = 1
CONTOUR_POINTS = 96
# Distance of the virtual camera in bounding radii: far enough that perspective matters little, near enough to be real.
_DISTANCE_RADII = 8.0
_RENDER_PX = 112
# Parts of a silhouette narrower than about twice this share of its longer side are thin, unless this much of its area
# is: then it is a thin body that is seen.
_THIN_SHARE = 0.013
_THIN_BODY_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class ViewBank:
    """Silhouettes of one target from V directions, F = n_angles // 2 + 1 Fourier coefficients, P contour points.

    Attributes:
        R_cam_target: (V, 3, 3) orientation of each view, the camera looking at the centre of the target.
        spectrum: (F, V, rings) complex64 polar silhouettes, transformed over the angle.
        area: (V,) area of the polar silhouette, in the unit of an inner product of two grids.
        gyration: (V,) radius of gyration, tangent units at the view's distance.
        centroid: (V, 2) silhouette centroid, tangent units, from the projected centre.
        contour_m: (V, P, 3) contour points in the target frame.
        contour_weight: (V, P) contour length each stands for, zero where unused.
        distance_m: () distance of the virtual camera from the centre.
    """

    R_cam_target: Float
    spectrum: NDArray[np.complex64]
    area: Float32
    gyration: Float
    centroid: Float
    contour_m: Float
    contour_weight: Float
    distance_m: Float

    @property
    def n_angles(self) -> int:
        """Number of in-plane angles."""
        return 2 * (self.spectrum.shape[0] - 1)


def load_or_build(target: Target, renderer: Renderer, n_views: int, n_angles: int, thin_parts: bool = True) -> ViewBank:
    """The bank of a target from the cache folder, built and stored there when it is absent or damaged."""
    grid = f"{n_angles}:{N_RINGS}:{MAX_RADIUS}:{CONTOUR_POINTS}:{_DISTANCE_RADII}:{_RENDER_PX}"
    thin = "" if thin_parts else f":{_THIN_SHARE}:{_THIN_BODY_SHARE}"
    arrays = cached_arrays(
        "views",
        f"{target.sha256}:{_FORMAT}:{n_views}:{grid}{thin}",
        lambda: vars(build(target, renderer, n_views, n_angles, thin_parts)),
    )
    return ViewBank(**arrays)


def build(target: Target, renderer: Renderer, n_views: int, n_angles: int, thin_parts: bool = True) -> ViewBank:
    """Render every view and describe it, with or without its thin parts.

    ``n_views``: an icosphere size (162, 642, 2562); ``n_angles`` even.
    """
    rotations = look_inwards(n_views)
    center, radius = target.center_m, target.bounding_radius_m
    distance = _DISTANCE_RADII * radius
    focal = 0.5 * (_RENDER_PX - 6) / np.tan(np.arcsin(1.0 / _DISTANCE_RADII))
    K = np.array([[focal, 0, _RENDER_PX / 2 - 0.5], [0, focal, _RENDER_PX / 2 - 0.5], [0, 0, 1]])
    camera = Camera(K, _RENDER_PX, _RENDER_PX)
    rings = np.zeros((n_views, n_angles, N_RINGS), np.float32)
    gyration, centroid = np.ones(n_views), np.zeros((n_views, 2))
    contour, weight = np.zeros((n_views, CONTOUR_POINTS, 3)), np.zeros((n_views, CONTOUR_POINTS))
    for i, R in enumerate(rotations):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, np.array([0, 0, distance]) - R @ center
        view = renderer.render(T, camera, color=False)
        if not view.mask.any():  # a flat body seen exactly edge-on
            continue
        shape = view.mask if thin_parts else without_thin_parts(view.mask)
        moments = mask_moments(shape)
        rings[i] = polar_grid(shape.astype(np.float32), moments.center_px, moments.gyration_px, n_angles)
        gyration[i] = moments.gyration_px / focal
        centroid[i] = (moments.center_px - K[:2, 2]) / focal
        table = contour_table(view.depth_m, shape, K, CONTOUR_POINTS)
        contour[i, : len(table)] = (table[:, :3] - T[:3, 3]) @ R
        weight[i, : len(table)] = table[:, COL_WEIGHT]
    spectrum = np.ascontiguousarray(np.fft.rfft(rings, axis=1).transpose(1, 0, 2).astype(np.complex64))
    area = (rings @ ring_weights()).sum(axis=1)
    return ViewBank(rotations, spectrum, area, gyration, centroid, contour, weight, np.array(distance))


def without_thin_parts(mask: Bool) -> Bool:
    """A silhouette (H, W) with at least one pixel, its booms and antennas left out."""
    silhouette = np.ascontiguousarray(mask).view(np.uint8)
    x, y, width, height = cv2.boundingRect(silhouette)
    radius = round(_THIN_SHARE * max(width, height))
    if radius == 0:
        return mask
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    part = np.s_[y : y + height, x : x + width]
    body = np.zeros_like(mask)
    body[part] = cv2.morphologyEx(silhouette[part], cv2.MORPH_OPEN, kernel) > 0
    return body if np.count_nonzero(body) >= (1.0 - _THIN_BODY_SHARE) * np.count_nonzero(mask) else mask
