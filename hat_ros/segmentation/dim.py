"""What of a target before a black sky is too dim for single pixels: means of growing width, brighter things set aside.

A face that only scattered light reaches stands out of the noise by less than a single pixel shows, and a threshold
leaves specks of it. The mean of n x n pixels has an n-th of their noise, but spreads what is bright beyond its outline.
Therefore each width looks only for what the narrower ones could not see: what they found is clamped to what they just
see, less than twice what this one sees, so that a mean passes only where more than half of it lies on the target.
"""

from __future__ import annotations

import cv2
import numpy as np

from hat_ros.array_types import Bool, Float32, UInt8
from hat_ros.segmentation.masks import Mask, enlarge
from hat_ros.segmentation.sky import SKY_MAX, Sky, level_and_noise

_WIDTHS_PX = (5, 9, 17)
_NOISE_SIGMAS = 4.0
_MIN_STEP = 0.5  # grey levels; the halo that JPEG and glass lay around what is bright stays below, away from it
_MARGIN_PX = 2  # around what is bright, where that halo is stronger
_BRIGHT_STEPS = 2.0  # thresholds of single pixels above the sky: bright
_MIN_FREE = 0.25  # share of a mean that must not be bright
_BODY_SHARE = 0.25  # radius of the smallest dim part, of the mean's width
_REACH_SHARE = 0.3  # how far dim parts are looked for around the lit ones, of their longer side; and in pixels
_REACH_PX = 16
_WORK_SIDE_PX = 240  # a larger part of the image is reduced


def with_dim_parts(measured: Sky, lit: Mask) -> Mask:
    """A target's lit parts, (H, W) uint8 of 0 and 1 and not empty, together with the dim ones that hang on them."""
    x, y, w, h = cv2.boundingRect(lit)
    reach = round(_REACH_SHARE * max(w, h)) + _REACH_PX
    box = np.s_[max(0, y - reach) : y + h + reach, max(0, x - reach) : x + w + reach]
    mean3, step = measured.mean3[box], measured.threshold - measured.level
    bright = _above(mean3, measured.level + _BRIGHT_STEPS * step)
    above = _above(mean3, measured.threshold)
    factor = -(-max(above.shape) // _WORK_SIDE_PX)
    luma = _reduced(measured.luma[box], factor)
    ladder = [known for width in _WIDTHS_PX if (known := _noise(measured.luma, width, factor)) is not None]
    dim = _find(luma, _reduced(bright, factor) > 0, _reduced(above, factor) > 0.5, step, ladder)
    if not dim.any():
        return lit
    seen = above.astype(np.uint8)
    dim = enlarge(dim, (seen.shape[1], seen.shape[0]))
    count, piece = cv2.connectedComponents(dim | seen | lit[box], connectivity=8)
    hangs_on = np.bincount(piece[lit[box] > 0], minlength=count) > 0
    out = lit.copy()
    added = dim > seen  # single pixels have been judged before, and outlines trimmed
    out[box][added] |= hangs_on[piece[added]]
    return out


def _find(
    luma: Float32,
    bright: Bool,
    seen: Bool,
    step: float,
    ladder: list[tuple[int, float, float]],
) -> Mask:
    """What is not sky.

    Args:
        luma: (h, w) reduced part of the image.
        bright: (h, w) what tells nothing about its neighbours.
        seen: (h, w) what single pixels show to be no sky, ``step`` above it.
        step: in grey levels.
        ladder: width, level of the sky and threshold above it of each mean, narrow ones first.

    Returns:
        (h, w) uint8 of 0 and 1.
    """
    free = (cv2.dilate(bright.view(np.uint8), _disc(_MARGIN_PX)) == 0).astype(np.float32)
    found = np.zeros(bright.shape, np.uint8)
    for n, level, threshold in ladder:
        if threshold >= step:
            continue
        values = np.where(seen, np.minimum(luma, level + step), luma) - level
        share = cv2.boxFilter(free, -1, (n, n))
        mean = cv2.boxFilter(values.astype(np.float32) * free, -1, (n, n))  # times the share
        # Fewer pixels have more noise.
        more = ((share > _MIN_FREE) & (mean > threshold * np.sqrt(share))).astype(np.uint8)
        found |= np.asarray(cv2.morphologyEx(more, cv2.MORPH_OPEN, _disc(max(1, int(_BODY_SHARE * n)))), np.uint8)
        seen = seen | (found > 0)
        step = threshold
    return found


def _noise(image: UInt8, width: int, factor: int) -> tuple[int, float, float] | None:
    """A rung of the ladder: the width in reduced pixels, the sky's level and a threshold that its noise stays below.

    From strips along the border of an (H, W) image; None when that is too small or not dark.
    """
    n = 2 * round((width / factor - 1) / 2) + 1
    r = factor * (2 * n + 8)
    if min(image.shape) < 3 * r:
        return None
    strips = (image[:r], image[-r:], image[r:-r, :r], image[r:-r, -r:])
    values = np.concatenate([_reduced(strip, factor * n, whole=True).ravel() for strip in strips])
    values = values[values < SKY_MAX]
    if len(values) < 8:
        return None
    level, sigma = level_and_noise(values)
    return n, level, max(_NOISE_SIGMAS * sigma, _MIN_STEP)


def _reduced(image: UInt8 | Float32, factor: int, whole: bool = False) -> Float32:
    """Means of ``factor`` x ``factor`` pixels; ``whole`` ones only, what is left at the far sides dropped."""
    size = (-(-image.shape[1] // factor), -(-image.shape[0] // factor))
    if whole:
        size = (image.shape[1] // factor, image.shape[0] // factor)
        image = image[: size[1] * factor, : size[0] * factor]
    values = image.astype(np.float32, copy=False)
    if factor == 1:
        return values
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float32)


def _above(image: Float32, level: float) -> Float32:
    """1 where an image lies above a level, else 0."""
    return np.asarray(cv2.threshold(image, level, 1, cv2.THRESH_BINARY)[1], np.float32)


def _disc(radius_px: int) -> UInt8:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1, 2 * radius_px + 1)), np.uint8)
