"""Linear light in 8 bits: the square root spreads its levels as the eye and a sensor's noise do."""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Float32, UInt8

# What 255 stands for, in units of a white face square to the sun: twice saturated.
_WHITE = 2.0
_DECODED = (_WHITE * (np.arange(256) / 255.0) ** 2).astype(np.float32)


def encode(radiance: Float32) -> UInt8:
    """Radiance of any shape, in units of a white face square to the sun; above twice that it is cut off."""
    return (255.0 * np.sqrt(np.clip(radiance / _WHITE, 0, 1)) + 0.5).astype(np.uint8)


def decode(coded: UInt8) -> Float32:
    """The radiance again, to within 1 / 128 of its square root."""
    return _DECODED[coded]
