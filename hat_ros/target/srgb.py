"""Colours of files and images (sRGB) and the light that they stand for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import Float, UInt8


def linear_from_srgb(rgb: UInt8) -> Float:
    """Linear light 0..1 of 8-bit sRGB values (IEC 61966-2-1)."""
    c = np.asarray(rgb, dtype=np.float64) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: NDArray[np.floating]) -> UInt8:
    """8-bit sRGB values of linear light, clipped to 0..1 (IEC 61966-2-1)."""
    c = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    return np.rint(255.0 * np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)).astype(np.uint8)
