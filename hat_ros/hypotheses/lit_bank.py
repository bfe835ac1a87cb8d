"""A view bank of brightness instead of silhouettes: views from all sides under many directions of the sun.

Before a black sky a mask holds only what is lit, so its shape may be that of no view at all. Brightness can still be
compared: what is dark has no weight, in the image as in the prediction. Each view under each sun is laid on the same
polar grid as the silhouettes of :mod:`hat_ros.target.view_bank`, about the centroid of its light, so that the same
product of spectra correlates it with an image at every in-plane angle. The square root of brightness is compared,
because gloss, which is not modelled, would dominate otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import Float, Float32
from hat_ros.cache import cached_arrays
from hat_ros.refinement.sunlight import brightness
from hat_ros.refinement.view import Surfels, TargetViewer
from hat_ros.target.contour import COL_NU, COL_NV, COL_U, COL_V, COL_WEIGHT, contour_table
from hat_ros.target.masks import image_moments
from hat_ros.target.polar import MAX_RADIUS, N_RINGS, polar_grid
from hat_ros.target.rays import pixel_rays
from hat_ros.target.sphere import look_inwards
from hat_ros.target.view_bank import CONTOUR_POINTS, ViewBank
from hat_ros.types import Camera

_FORMAT = 2
_N_VIEWS = 162
# Phase angles (sun, target, camera) in degrees, each with a number of suns around the line of sight.
# Nearer to the camera hardly anything is in shadow, further away hardly anything is lit.
_SUNS = ((40.0, 6), (75.0, 8), (110.0, 8))
_DISTANCE_RADII = 8.0
_RENDER_PX = 80
# Views whose silhouette is darker than this on average are left out.
_MIN_BRIGHTNESS = 0.01
# Brightness of the contour from which the image can show it.
_VISIBLE = 0.1


@dataclass(frozen=True, eq=False)
class LitBank(ViewBank):
    """A view bank of brightness, each spectrum of unit norm.

    Attributes:
        to_sun_cam: (V, 3) unit direction to the sun of each view, in the view's camera frame.
    """

    to_sun_cam: Float


def load_or_build_lit(viewer: TargetViewer, n_angles: int) -> LitBank:
    """The bank of a target from the cache folder, built and stored there when it is absent or damaged."""
    settings = f"{_FORMAT}:{_N_VIEWS}:{n_angles}:{N_RINGS}:{MAX_RADIUS}:{CONTOUR_POINTS}:{_SUNS}:{_RENDER_PX}"
    arrays = cached_arrays("lit-views", f"{viewer.target.sha256}:{settings}", lambda: vars(build_lit(viewer, n_angles)))
    return LitBank(**arrays)


def sun_directions() -> Float:
    """(S, 3) unit directions to the suns of the bank, camera frame (z away from the camera)."""
    out = []
    for phase_deg, count in _SUNS:
        phase = np.radians(phase_deg)
        azimuth = np.arange(count) * (2.0 * np.pi / count)
        out += [[np.sin(phase) * np.cos(a), np.sin(phase) * np.sin(a), -np.cos(phase)] for a in azimuth]
    return np.array(out)


def subdued(light: Float32) -> Float32:
    """Brightness as it is compared, of any scale."""
    return np.sqrt(light)


def build_lit(viewer: TargetViewer, n_angles: int) -> LitBank:
    """Render every view under every sun and describe its brightness."""
    distance = _DISTANCE_RADII * viewer.target.bounding_radius_m
    suns = sun_directions()
    R_all, sun_all, described, contours = [], [], [], []
    for R in look_inwards(_N_VIEWS):
        view = _OneView(viewer, R, distance)
        for sun in suns:
            image = view.image(sun)
            if image.sum() < _MIN_BRIGHTNESS * max(len(view.seen.pixel), 1):
                continue
            R_all.append(R)
            sun_all.append(sun)
            described.append(_describe(subdued(image), view.camera, n_angles))
            contours.append(view.contour(image))
    n = len(R_all)
    contour, weight = np.zeros((n, CONTOUR_POINTS, 3)), np.zeros((n, CONTOUR_POINTS))
    for i, (points, lengths) in enumerate(contours):
        contour[i, : len(points)], weight[i, : len(points)] = points, lengths
    spectrum, centroid, gyration = (np.array(column) for column in zip(*described, strict=True))
    spectrum = np.ascontiguousarray(spectrum.transpose(1, 0, 2).astype(np.complex64))
    area = np.ones(n, np.float32)
    return LitBank(
        np.array(R_all), spectrum, area, gyration, centroid, contour, weight, np.array(distance), np.array(sun_all)
    )


class _OneView:
    """The target from one direction, to be shaded under many suns."""

    def __init__(self, viewer: TargetViewer, R: Float, distance_m: float) -> None:
        focal = 0.5 * (_RENDER_PX - 6) / np.tan(np.arcsin(1.0 / _DISTANCE_RADII))
        middle = _RENDER_PX / 2 - 0.5
        self.camera = Camera(np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]]), _RENDER_PX, _RENDER_PX)
        self._viewer, self._R = viewer, R
        self._t = np.array([0, 0, distance_m]) - R @ viewer.target.center_m
        pixels = np.arange(_RENDER_PX)
        rays = pixel_rays(self.camera, pixels, pixels).reshape(-1, 3)
        self.seen: Surfels = viewer.surface(rays @ R, -self._t @ R)
        self._albedo = self.seen.rgb.astype(np.float32).mean(axis=1) / np.float32(255)
        mask, depth = np.zeros(len(rays), np.bool_), np.zeros(len(rays), np.float32)
        mask[self.seen.pixel] = True
        depth[self.seen.pixel] = self.seen.points_m @ R[2].astype(np.float32) + np.float32(self._t[2])
        self._shape = (_RENDER_PX, _RENDER_PX)
        self._table = contour_table(
            depth.reshape(self._shape), mask.reshape(self._shape), self.camera.K, 4 * CONTOUR_POINTS
        )

    def image(self, to_sun_cam: Float) -> Float32:
        """(side, side) encoded brightness, 0 to 1."""
        seen = self.seen
        to_sun = (to_sun_cam @ self._R).astype(np.float32)
        cosine = self._viewer.sunlit(seen.points_m, seen.normals, to_sun)
        image = np.zeros(self._shape[0] * self._shape[1], np.float32)
        image[seen.pixel] = self._albedo * brightness(cosine)
        return image.reshape(self._shape)

    def contour(self, image: Float32) -> tuple[Float, Float]:
        """Contour points (P, 3) in the target frame that such light shows, and the length each stands for (P,)."""
        table = self._table
        inner = np.rint(table[:, [COL_V, COL_U]] - table[:, [COL_NV, COL_NU]]).astype(np.intp)
        table = table[image[inner[:, 0], inner[:, 1]] > _VISIBLE]
        table = table[:: max(1, -(-len(table) // CONTOUR_POINTS))]
        return (table[:, :3] - self._t) @ self._R, table[:, COL_WEIGHT]


def _describe(image: Float32, camera: Camera, n_angles: int) -> tuple[NDArray[np.complex64], Float, float]:
    """Spectrum (F, rings) of unit norm, centroid and radius of gyration in tangent units."""
    moments = image_moments(image)
    grid = polar_grid(image, moments.center_px, moments.gyration_px, n_angles)
    spectrum = np.fft.rfft(grid / np.linalg.norm(grid), axis=0).astype(np.complex64)
    return spectrum, (moments.center_px - camera.K[:2, 2]) / camera.K[0, 0], moments.gyration_px / camera.K[0, 0]
