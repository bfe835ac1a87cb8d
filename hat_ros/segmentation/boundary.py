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
    moved = _decide(rgb, mask, inner, outer, 2 * band_px + 2, np.float32(contrast * contrast))
    # A lone pixel that disagrees with most of its neighbours is noise.
    smooth = cv2.medianBlur(moved, 3)
    return np.where(inner == outer, mask, smooth)


@njit(cache=True, nogil=True)
def _decide(rgb, mask, inner, outer, window, contrast_sq):  # noqa: ANN001, ANN202 - compiled
    h, w = mask.shape
    out = mask.copy()
    for y in range(h):
        for x in range(w):
            if inner[y, x] == outer[y, x]:
                continue
            n_f = 0
            n_b = 0
            f0 = f1 = f2 = b0 = b1 = b2 = np.float32(0)
            # Every other pixel is enough for a mean.
            for j in range(max(0, y - window), min(h, y + window + 1), 2):
                for i in range(max(0, x - window), min(w, x + window + 1), 2):
                    if inner[j, i] == 1:
                        n_f += 1
                        f0 += rgb[j, i, 0]
                        f1 += rgb[j, i, 1]
                        f2 += rgb[j, i, 2]
                    elif outer[j, i] == 0:
                        n_b += 1
                        b0 += rgb[j, i, 0]
                        b1 += rgb[j, i, 1]
                        b2 += rgb[j, i, 2]
            if n_f < 3 or n_b < 3:
                continue
            b0, b1, b2 = b0 / n_b, b1 / n_b, b2 / n_b
            d0, d1, d2 = f0 / n_f - b0, f1 / n_f - b1, f2 / n_f - b2
            norm_sq = d0 * d0 + d1 * d1 + d2 * d2
            if norm_sq < contrast_sq:
                continue
            along = (rgb[y, x, 0] - b0) * d0 + (rgb[y, x, 1] - b1) * d1 + (rgb[y, x, 2] - b2) * d2
            out[y, x] = 1 if 2 * along > norm_sq else 0
    return out
