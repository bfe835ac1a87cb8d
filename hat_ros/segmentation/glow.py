"""Stray light before a black sky: a smooth glow around the sun, from a lit limb or a lens, told from what has outlines.

From the image border inwards everything is glow that changes little from one place to the next, compared with its own
brightness; behind what is not, the glow goes on smoothly. A threshold would take all of it for the target.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hat_ros.array_types import Float32, UInt8
from hat_ros.segmentation.masks import Mask, touches_border
from hat_ros.segmentation.sky import Sky, dark_border_share, lit_regions, measure_sky

_STRAY_SHARE = 0.85  # of the dark border that a black sky has is left at least where stray light falls on it
_SIDE_PX = 160  # longer side of the image on which the glow is followed
# Largest relative step between neighbours there, and the grey levels added to both so that noise stays below it. A glow
# that fades to a third within a ninth of the image takes steps of this size; outlines take several times as large ones.
_MAX_STEP = 0.06
_ADDED_LEVELS = 16.0
_PEDESTAL = 8  # grey level of what is left of the sky, so that its noise shows on both sides
# A ring so far outside a region; more of it than this share, above half the threshold, means that the region fades out.
# Less where the image border cuts the region, as it does most glows: the rest may be the outline of a target in it.
_RING_PX = (3, 4)
_MAX_SOFT_SHARE, _MAX_SOFT_SHARE_CUT = 0.45, 0.25


@dataclass(frozen=True, eq=False)
class Space:
    """What is seen before a black sky.

    Attributes:
        rgb: (H, W, 3) uint8 image, without its stray light where that was in the way.
        sky: brightness of the sky in it.
        regions: what is lit in it, see :func:`hat_ros.segmentation.sky.lit_regions`.
    """

    rgb: UInt8
    sky: Sky
    regions: list[Mask]


def look_into_space(rgb: UInt8, border_share: float) -> Space | None:
    """The sky in an (H, W, 3) uint8 image and what is lit before it; None unless so much of the border is black sky.

    Stray light is taken off first where it hides that sky, or where the brightest region fades out instead of ending;
    unless something fades out even then.
    """
    if dark_border_share(rgb) < _STRAY_SHARE * border_share:
        return None
    space = _measured(rgb, border_share)
    if space is not None and not _is_hazy(space):
        return space
    cleared = _measured(without_glow(rgb), border_share)
    return space if cleared is None or _is_hazy(cleared) else cleared


def _measured(rgb: UInt8, border_share: float) -> Space | None:
    sky = measure_sky(rgb)
    return Space(rgb, sky, lit_regions(sky)) if sky.border_share >= border_share else None


def _is_hazy(space: Space) -> bool:
    return bool(space.regions) and fades_out(space.sky, space.regions[0])


def fades_out(measured: Sky, region: Mask) -> bool:
    """Whether a bright region, (H, W) 0/1 and not empty, has no outline for the most part: a target's is sharp."""
    reach = _RING_PX[1]
    x, y, w, h = cv2.boundingRect(region)
    box = np.s_[max(0, y - reach) : y + h + reach, max(0, x - reach) : x + w + reach]
    near, far = (cv2.dilate(region[box], np.ones((2 * r + 1, 2 * r + 1), np.uint8)) for r in _RING_PX)
    around = measured.mean3[box][near != far]
    half = 0.5 * (measured.level + measured.threshold)
    most = _MAX_SOFT_SHARE_CUT if touches_border(region) else _MAX_SOFT_SHARE
    return bool(np.count_nonzero(around > half) > most * len(around))


def without_glow(rgb: UInt8) -> UInt8:
    """An (H, W, 3) uint8 image with its glow taken off, the sky at a low grey level."""
    h, w = rgb.shape[:2]
    scale = min(1.0, _SIDE_PX / max(h, w))
    size = (max(2, round(w * scale)), max(2, round(h * scale)))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    known = cv2.erode(_smooth_from_border(small), np.ones((3, 3), np.uint8)).astype(np.float32)
    glow = cv2.resize(_continued(small, known), (w, h), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.subtract(rgb, glow - _PEDESTAL, dtype=cv2.CV_8U), np.uint8)


def _smooth_from_border(image: Float32) -> Mask:
    """What can be reached from the border of an (h, w, 3) image in small steps, 0/1."""
    brightness = np.log(image + _ADDED_LEVELS)
    h, w = brightness.shape[:2]
    reached = np.zeros((h + 2, w + 2), np.uint8)
    middles = ((w // 2, 0), (w // 2, h - 1), (0, h // 2), (w - 1, h // 2))
    for x, y in ((0, 0), (w - 1, 0), (0, h - 1), (w - 1, h - 1), *middles):
        if not reached[y + 1, x + 1]:
            step = (_MAX_STEP,) * 3
            cv2.floodFill(brightness, reached, (x, y), 0, step, step, 4 | cv2.FLOODFILL_MASK_ONLY)
    return reached[1:-1, 1:-1]


def _continued(image: Float32, known: Float32) -> Float32:
    """An (h, w, 3) image continued smoothly where it is not known, 0/1: by its own reduced version there."""
    h, w = known.shape
    if known.all() or min(h, w) <= 2:
        total = known.sum()
        mean = (image * known[..., None]).sum(axis=(0, 1)) / total if total else np.zeros(3, np.float32)
        return np.where(known[..., None] > 0, image, mean).astype(np.float32)
    half = ((w + 1) // 2, (h + 1) // 2)
    weight = cv2.pyrDown(known, dstsize=half)
    reduced = cv2.pyrDown(image * known[..., None], dstsize=half) / np.maximum(weight, 1e-6)[..., None]
    below = _continued(reduced.astype(np.float32, copy=False), (weight > 1e-3).astype(np.float32))
    return np.where(known[..., None] > 0, image, cv2.pyrUp(below, dstsize=(w, h)))
