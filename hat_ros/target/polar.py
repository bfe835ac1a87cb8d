"""Images on polar grids about a centre, radii in units of a radius of gyration.

On such a grid position and size of a silhouette drop out, and a turn about the optical axis is a shift of the angle.
"""

from __future__ import annotations

import cv2
import numpy as np

from hat_ros.array_types import Float, Float32

N_RINGS = 32
# Outer radius of the polar grid in radii of gyration: the far end of a lopsided slender body lies at about 2.5.
MAX_RADIUS = 2.6


def polar_grid(image: Float32, center_px: Float, gyration_px: float, n_angles: int) -> Float32:
    """Sample an image, black beyond its border, on rings about a centre: (n_angles, rings), weighted.

    Each sample carries the square root of its area, so that the inner product of two grids is an area of overlap and
    both sides of the product are weighted alike.
    """
    return PolarSampler(image).grid(center_px, gyration_px, n_angles)


class PolarSampler:
    """Samples one image on many polar grids; see :func:`polar_grid`.

    Args:
        image: (H, W) float32; only the part that is not black is looked at.
    """

    def __init__(self, image: Float32) -> None:
        self._image = image
        self._left, self._top, self._width, self._height = cv2.boundingRect((image != 0).view(np.uint8))
        self._averaged: dict[int, tuple[Float32, int, int]] = {}

    def grid(self, center_px: Float, gyration_px: float, n_angles: int) -> Float32:
        """(n_angles, rings) about a centre, pixels."""
        radius, angle = _polar(gyration_px, n_angles)
        image, left, top = self._average(int(gyration_px * MAX_RADIUS / N_RINGS))
        x = (center_px[0] - left + radius * np.cos(angle)).astype(np.float32)
        y = (center_px[1] - top + radius * np.sin(angle)).astype(np.float32)
        return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) * ring_weights()

    def _average(self, step_px: int) -> tuple[Float32, int, int]:
        """What lies between two samples averaged: the part of the image that is not black then, and its corner."""
        if step_px not in self._averaged:
            left, top = max(self._left - step_px, 0), max(self._top - step_px, 0)
            part = self._image[top : self._top + self._height + step_px, left : self._left + self._width + step_px]
            if step_px > 1:
                blurred = cv2.blur(part, (step_px, step_px), borderType=cv2.BORDER_REPLICATE)
                part = np.asarray(blurred, np.float32)
            self._averaged[step_px] = part, left, top
        return self._averaged[step_px]


def border_grid(shape: tuple[int, ...], center_px: Float, gyration_px: float, n_angles: int) -> Float32:
    """The :func:`polar_grid` of an image (H, W) of ones: what of the grid lies inside the image."""
    radius, angle = _polar(gyration_px, n_angles)
    inside = np.ones((n_angles, N_RINGS))
    for middle, size, direction in zip(center_px, shape[::-1], (np.cos(angle), np.sin(angle)), strict=True):
        at = middle + radius * direction
        inside *= np.clip(np.minimum(at + 1.0, size - at), 0.0, 1.0)
    return inside.astype(np.float32) * ring_weights()


def _polar(gyration_px: float, n_angles: int) -> tuple[Float, Float]:
    """Radii (rings,) of a polar grid, pixels, and its angles (n_angles, 1), radians."""
    radius_px = (np.arange(N_RINGS, dtype=np.float64) + 0.5) * (gyration_px * MAX_RADIUS / N_RINGS)
    return radius_px, (np.arange(n_angles, dtype=np.float64) * (2.0 * np.pi / n_angles))[:, None]


def ring_weights() -> Float32:
    """(rings,) square root of the area of a sample on each ring, up to a common factor."""
    return np.sqrt((np.arange(N_RINGS) + 0.5) * (MAX_RADIUS / N_RINGS)).astype(np.float32)
