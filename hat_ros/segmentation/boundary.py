"""The outline at full resolution: each pixel near it goes to the side whose local colour it is closer to.

The generalisation of the half-maximum rule to two sides: with local mean colours F inside and B outside, a pixel of
colour I lies inside when its mixing ratio ``(I - B).(F - B) / |F - B|^2`` exceeds one half, which puts the outline
where a sharp edge crosses the pixel's middle, without bias from exposure or contrast.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from hat_ros.array_types import Int32, UInt8

# Fewer known pixels of one side around a pixel tell nothing about that side.
_MIN_PIXELS = 12
# From a band this wide on, every second pixel of every second row is example enough of the colours around.
_WIDE_BAND_PX = 4


def refine_outline(rgb: UInt8, mask: UInt8, band_px: int, contrast: float) -> UInt8:
    """Move the outline of a mask by up to ``band_px`` pixels to where the local colours change.

    Args:
        rgb: (h, w, 3) uint8 crop.
        mask: (h, w) uint8 of 0 and 1.
        band_px: pixels this close to the outline are decided anew.
        contrast: colour distance (8-bit RGB) below which the two sides are indistinguishable and nothing moves.

    Returns:
        (h, w) uint8 of 0 and 1.
    """
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band_px + 1, 2 * band_px + 1))
    inner = np.asarray(cv2.erode(mask, kernel, borderType=cv2.BORDER_REPLICATE), np.uint8)
    outer = np.asarray(cv2.dilate(mask, kernel, borderType=cv2.BORDER_REPLICATE), np.uint8)
    open_xy = cv2.findNonZero(inner ^ outer)
    if open_xy is None:
        return mask
    examples, known_inside, known_outside, step = rgb, inner, 1 - outer, 1
    if band_px >= _WIDE_BAND_PX:
        examples, known_inside, known_outside = (_every_second(each) for each in (rgb, inner, 1 - outer))
        step = 2
    inside, outside = _area_table(examples, known_inside), _area_table(examples, known_outside)
    reach, least = (2 * band_px + 2) // step, max(1, _MIN_PIXELS // step**2)
    at = np.asarray(open_xy, np.int32).reshape(-1, 2)
    moved = _decide(rgb, mask, at, *inside, *outside, step, reach, least, np.float32(contrast * contrast))
    # A lone pixel that disagrees with most of its neighbours is noise.
    smooth = cv2.medianBlur(moved, 3)
    return np.where(inner == outer, mask, smooth)


def warm_up() -> None:
    """Move a made-up outline, so that everything is compiled before the first frame comes."""
    mask = np.zeros((16, 16), np.uint8)
    mask[4:12, 4:12] = 1
    refine_outline(np.zeros((16, 16, 3), np.uint8), mask, 1, 1.0)


def _every_second(image: UInt8) -> UInt8:
    """Every second pixel of every second row of an (h, w, ...) image, an odd rest dropped."""
    h, w = image.shape[0] // 2, image.shape[1] // 2
    return np.asarray(cv2.resize(image[: 2 * h, : 2 * w], (w, h), interpolation=cv2.INTER_NEAREST), np.uint8)


def _area_table(rgb: UInt8, mask: UInt8) -> tuple[Int32, Int32]:
    """Summed-area tables (h + 1, w + 1) of a 0/1 mask and (h + 1, w + 1, 3) of the colours in it."""
    count = cv2.integral(mask, sdepth=cv2.CV_32S)
    colour = cv2.integral(cv2.copyTo(rgb, mask), sdepth=cv2.CV_32S)
    return np.asarray(count, np.int32), np.asarray(colour, np.int32)


@njit(cache=True, nogil=True)
def _box_sum(table: Int32, x0: int, y0: int, x1: int, y1: int) -> np.float32:
    """Sum over a half-open box; right even where a large table has wrapped around."""
    return np.float32(np.int32(table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0]))


@njit(cache=True, nogil=True)
def _color_sum(table: Int32, x0: int, y0: int, x1: int, y1: int, c: int) -> np.float32:
    """The same of one colour."""
    return np.float32(np.int32(table[y1, x1, c] - table[y0, x1, c] - table[y1, x0, c] + table[y0, x0, c]))


@njit(cache=True, nogil=True)
def _decide(
    rgb: UInt8,
    mask: UInt8,
    open_xy: Int32,
    n_inside: Int32,
    inside: Int32,
    n_outside: Int32,
    outside: Int32,
    step: int,
    reach: int,
    least: int,
    contrast_sq: np.float32,
) -> UInt8:
    """A mask with its open pixels (n, 2) decided anew, from the area tables of both sides."""
    out = mask.copy()
    h, w = n_inside.shape[0] - 1, n_inside.shape[1] - 1
    for i in range(len(open_xy)):
        x, y = open_xy[i]
        u, v = x // step, y // step
        box = max(0, u - reach), max(0, v - reach), min(w, u + reach + 1), min(h, v + reach + 1)
        n_f, n_b = _box_sum(n_inside, *box), _box_sum(n_outside, *box)
        if n_f < least or n_b < least:
            continue
        along = norm_sq = np.float32(0.0)
        for c in range(3):
            background = _color_sum(outside, *box, c) / n_b
            d = _color_sum(inside, *box, c) / n_f - background
            norm_sq += d * d
            along += (rgb[y, x, c] - background) * d
        if norm_sq < contrast_sq:
            continue
        out[y, x] = 1 if 2 * along > norm_sq else 0
    return out
