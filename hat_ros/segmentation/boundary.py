"""The outline at full resolution: each pixel near it goes to the side whose local colour it is closer to.

The generalisation of the half-maximum rule to two sides: with local mean colours F inside and B outside, a pixel of
colour I lies inside when its mixing ratio ``(I - B).(F - B) / |F - B|^2`` exceeds one half, which puts the outline
where a sharp edge crosses the pixel's middle, without bias from exposure or contrast.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

# Fewer known pixels of one side around a pixel tell nothing about that side.
_MIN_PIXELS = 12


def refine_outline(rgb: NDArray[np.uint8], mask: NDArray[np.uint8], band_px: int, contrast: float) -> NDArray[np.uint8]:
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
    inner = cv2.erode(mask, kernel, borderType=cv2.BORDER_REPLICATE)
    outer = cv2.dilate(mask, kernel, borderType=cv2.BORDER_REPLICATE)
    inside, outside = _area_table(rgb, inner), _area_table(rgb, 1 - outer)
    moved = _decide(rgb, mask, inner, outer, *inside, *outside, 2 * band_px + 2, np.float32(contrast * contrast))
    # A lone pixel that disagrees with most of its neighbours is noise.
    smooth = cv2.medianBlur(moved, 3)
    return np.where(inner == outer, mask, smooth)


def _area_table(rgb: NDArray[np.uint8], mask: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Summed-area tables (h + 1, w + 1) of a 0/1 mask and (h + 1, w + 1, 3) of the colours in it."""
    return cv2.integral(mask, sdepth=cv2.CV_32S), cv2.integral(cv2.copyTo(rgb, mask), sdepth=cv2.CV_32S)


@njit(cache=True, nogil=True)
def _box_sum(table, x0, y0, x1, y1):  # noqa: ANN001, ANN202 - compiled
    """Sum over a half-open box; right even where a large table has wrapped around."""
    return np.float32(np.int32(table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0]))


@njit(cache=True, nogil=True)
def _mean_color(count, sums, x0, y0, x1, y1):  # noqa: ANN001, ANN202 - compiled
    """Mean over the masked pixels of a box, given that there are some."""
    n = _box_sum(count, x0, y0, x1, y1)
    r = _box_sum(sums[:, :, 0], x0, y0, x1, y1)
    g = _box_sum(sums[:, :, 1], x0, y0, x1, y1)
    b = _box_sum(sums[:, :, 2], x0, y0, x1, y1)
    return r / n, g / n, b / n


@njit(cache=True, nogil=True)
def _decide(rgb, mask, inner, outer, n_inside, inside, n_outside, outside, reach, contrast_sq):  # noqa: ANN001, ANN202 - compiled
    h, w = mask.shape
    out = mask.copy()
    for y in range(h):
        for x in range(w):
            if inner[y, x] == outer[y, x]:
                continue
            box = max(0, x - reach), max(0, y - reach), min(w, x + reach + 1), min(h, y + reach + 1)
            if _box_sum(n_inside, *box) < _MIN_PIXELS or _box_sum(n_outside, *box) < _MIN_PIXELS:
                continue
            f0, f1, f2 = _mean_color(n_inside, inside, *box)
            b0, b1, b2 = _mean_color(n_outside, outside, *box)
            d0, d1, d2 = f0 - b0, f1 - b1, f2 - b2
            norm_sq = d0 * d0 + d1 * d1 + d2 * d2
            if norm_sq < contrast_sq:
                continue
            along = (rgb[y, x, 0] - b0) * d0 + (rgb[y, x, 1] - b1) * d1 + (rgb[y, x, 2] - b2) * d2
            out[y, x] = 1 if 2 * along > norm_sq else 0
    return out
