"""Boolean images: overlap and moments."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from hat_ros.array_types import Bool, Float, Float32, UInt8


def overlap(a: Bool | UInt8, b: Bool | UInt8) -> float:
    """Intersection over union; 0 when both are empty."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 0.0


class Moments(NamedTuple):
    """Where the pixels of an image lie and how far they spread.

    Attributes:
        center_px: (2,) centroid, pixels.
        variance_px2: mean squared distance of the pixels' centres from it.
    """

    center_px: Float
    variance_px2: float

    @property
    def gyration_px(self) -> float:
        """Radius of gyration, pixels."""
        # A pixel is a square, so even a single one has a radius of gyration: 1/12 of its side squared per axis.
        return float(np.sqrt(self.variance_px2 + 1.0 / 6.0))


def mask_moments(mask: Bool | UInt8) -> Moments:
    """Moments of a mask (H, W) with at least one pixel set."""
    pixels = mask.view(np.uint8)
    x, y, width, height = cv2.boundingRect(pixels)
    m = cv2.moments(np.ascontiguousarray(pixels[y : y + height, x : x + width]), binaryImage=True)
    area = m["m00"]
    return Moments(np.array([m["m10"] / area + x, m["m01"] / area + y]), (m["mu20"] + m["mu02"]) / area)


def image_moments(image: Float32) -> Moments:
    """Moments of the light in an image (H, W) that is not black."""
    m = cv2.moments(image)
    return Moments(np.array([m["m10"], m["m01"]]) / m["m00"], (m["mu20"] + m["mu02"]) / m["m00"])
