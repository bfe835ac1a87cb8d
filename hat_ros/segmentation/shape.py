"""Is this mask an outline that the CAD model can have? Overlap with the nearest of its silhouettes.

Each silhouette is resampled on a polar grid about its centroid, radii in units of its radius of gyration, so that
position, range and in-plane rotation drop out: the last is a circular shift of the angle, searched for all angles at
once by FFT. Where a mask is cut by the image border, what lies outside is unknown: it counts neither for nor against a
silhouette, and the true centre and size are searched beyond the border.
"""

from __future__ import annotations

import cv2
import numpy as np

from hat_ros.array_types import Bool, Float, Float32, UInt8
from hat_ros.cache import cached_arrays
from hat_ros.geometry import lie
from hat_ros.target.masks import mask_moments
from hat_ros.target.model import Target
from hat_ros.target.rendering import Renderer
from hat_ros.target.sphere import icosphere, look_along
from hat_ros.types import Camera

_FORMAT = 1  # raised whenever what is cached changes its meaning
_SIDE_PX = 96  # side of the rendered silhouettes
_RADII = 24
_ANGLES = 64
_EXTENT = 3.0  # largest radius of the grid, in radii of gyration; a rod seen from its end third stays inside
_DISTANCE_RADII = 6.0  # range of the rendered views, in bounding radii: middle of what fills 5 to 50 % of an image
# Of a cut mask: how far the true centre lies beyond its own, in its radii of gyration; the true radius over its own.
_CUT_GUESSES = ((0.0, 1.0), (0.25, 1.0), (0.25, 1.2), (0.5, 1.2), (0.5, 1.45), (0.75, 1.45))


class SilhouetteBank:
    """Silhouettes of a target from all around.

    Args:
        target: the CAD model.
        renderer: renders it.
        n_views: size of the icosphere of view directions (with 162, the nearest often lies too far off a mask of thin
            parts).
    """

    def __init__(self, target: Target, renderer: Renderer, n_views: int = 642) -> None:
        key = f"{target.sha256}:{_FORMAT}:{n_views}:{_SIDE_PX}:{_RADII}:{_ANGLES}:{_EXTENT}:{_DISTANCE_RADII}"
        views = cached_arrays("silhouettes", key, lambda: {"views": _silhouettes(target, renderer, n_views)})["views"]
        radii = (np.arange(_RADII) + 0.5) * (_EXTENT / _RADII)
        self._weight = (radii / radii.sum() / _ANGLES).astype(np.float32)  # area of a polar cell
        spectra = np.conj(np.fft.rfft(views, axis=-1) * self._weight[:, None]).astype(np.complex64)
        self._spectra = np.ascontiguousarray(spectra.transpose(2, 0, 1))  # frequency, view, radius
        self._areas = np.einsum("vra,r->v", views, self._weight)

    def overlap(self, mask: Bool) -> float:
        """Best intersection over union of an (H, W) mask with any silhouette, 0 to 1."""
        if not mask.any():
            return 0.0
        image = mask.astype(np.uint8)
        center, radius = _placement(mask)
        outward = _cut_direction(mask)
        if outward is None:
            return self._overlap_at(_polar(image, center, radius), None)
        inside = np.ones_like(image)
        best = 0.0
        for shift, scale in _CUT_GUESSES:
            at, size = center + shift * radius * outward, scale * radius
            best = max(best, self._overlap_at(_polar(image, at, size), _polar(inside, at, size)))
        return best

    def _overlap_at(self, polar: Float32, known: Float32 | None) -> float:
        inter = self._correlate(polar)
        area = float(polar.sum(axis=1) @ self._weight)
        areas = self._areas[:, None]
        if known is not None:
            areas = self._correlate(known)
        return float((inter / np.maximum(areas + area - inter, 1e-9)).max())

    def _correlate(self, polar: Float32) -> Float32:
        """Area (views, angles) that a polar image shares with every silhouette at every angle."""
        spectrum = np.fft.rfft(polar, axis=-1).astype(np.complex64)
        shared = np.matmul(self._spectra, spectrum.T[:, :, None])[:, :, 0]
        return np.asarray(np.fft.irfft(shared.T, n=_ANGLES, axis=-1), np.float32)


def _silhouettes(target: Target, renderer: Renderer, n_views: int) -> Float32:
    """(V, radii, angles) polar silhouettes of the views that show anything."""
    distance = _DISTANCE_RADII * target.bounding_radius_m
    focal = 0.47 * _SIDE_PX * np.sqrt(_DISTANCE_RADII**2 - 1.0)
    middle = (_SIDE_PX - 1) / 2
    camera = Camera(np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]]), _SIDE_PX, _SIDE_PX)
    forward = -icosphere(n_views)
    down = np.eye(3)[np.argmin(np.abs(forward), axis=1)]  # the roll is arbitrary
    polar = []
    for R in look_along(forward, down):
        T = lie.transform(R, np.array([0, 0, distance]) - R @ target.center_m)
        mask = renderer.render(T, camera, color=False).mask
        if mask.any():
            polar.append(_polar(mask.astype(np.uint8), *_placement(mask)))
    return np.stack(polar)


def _placement(mask: Bool) -> tuple[Float, float]:
    """Centroid (2,) and radius of gyration of a mask, pixels."""
    moments = mask_moments(mask)
    return moments.center_px, max(float(np.sqrt(moments.variance_px2)), 0.5)


def _polar(image: UInt8, center: Float, radius: float) -> Float32:
    """(radii, angles) samples of a binary image about a centre; 0 outside the image."""
    r = (np.arange(_RADII) + 0.5) * (_EXTENT / _RADII * radius)
    angle = np.arange(_ANGLES) * (2 * np.pi / _ANGLES)
    x = (center[0] + r[:, None] * np.cos(angle)).astype(np.float32)
    y = (center[1] + r[:, None] * np.sin(angle)).astype(np.float32)
    values = image.astype(np.float32)
    polar = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(polar, np.float32)


def _cut_direction(mask: Bool) -> Float | None:
    """Unit vector from the mask's middle towards where the image border cuts it, or None."""
    weights = np.array([mask[:, 0].sum(), mask[:, -1].sum(), mask[0].sum(), mask[-1].sum()], dtype=np.float64)
    if not weights.any():
        return None
    directions = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    vector = weights @ directions
    norm = np.linalg.norm(vector)
    return vector / norm if norm > 0 else np.zeros(2)
