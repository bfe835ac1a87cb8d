"""A target in a grey image before a textured background, by its outlines: near and man-made, they are sharp.

Clouds and coasts seen from orbit are soft or faint beside them. Without colour a graph cut can tell little, since both
sides hold the same greys; so what lies among sharp outlines, gaps bridged, is tried as a target as well, and a mask
is the less plausible the fewer of the sharp outlines it holds.
"""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.segmentation.masks import Mask, fill_holes
from hat_ros.segmentation.region import tidy

# Steps across two pixels that make an outline sharp, as shares of the image's range of greys; the middle one is what
# masks are judged by.
_SHARP_SHARES = (0.16, 0.2, 0.25)
_JUDGED = 1
_RANGE_PERCENT = (1, 99)
_MIN_RANGE = 40.0
# Gaps bridged between outlines, as radii in pixels of a picture whose longer side has 320.
_BRIDGED_PX = (2, 4, 7, 11)
_PICTURE_SIDE_PX = 320
_SPECK_PX = 25  # area of an outline with its neighbours below which it is noise, a star or a wave ...
_MIN_AREA_PX = 60  # ... and of a target
_FEW = 20  # fewer sharp pixels tell nothing
_BESIDE_PX = 2  # outlines lie on both sides of a mask's own

_K3 = np.ones((3, 3), np.uint8)


def is_grey(rgb: UInt8) -> bool:
    """Whether an (H, W, 3) image holds no colour at all, as from a monochrome camera."""
    red, green, blue = cv2.split(rgb)
    return np.array_equal(red, green) and np.array_equal(red, blue)


class SharpOutlines:
    """The sharp outlines of one picture.

    Args:
        grey: (h, w) uint8, reduced.
        size: width and height of the masks that are made and judged.
    """

    def __init__(self, grey: UInt8, size: tuple[int, int]) -> None:
        dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=0.25)
        dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3, scale=0.25)
        low, high = np.percentile(grey, _RANGE_PERCENT)
        self._step = cv2.magnitude(dx, dy) / max(float(high - low), _MIN_RANGE)
        self._scale = max(grey.shape) / _PICTURE_SIDE_PX
        self._size = size

    def held_beyond_chance(self, mask: Mask) -> float | None:
        """Share of the sharp outlines that a 0/1 mask holds, less its share of the picture, which it would hold if they
        lay anywhere; None where there are hardly any."""
        total = np.count_nonzero(self._judged)
        if total < _FEW:
            return None
        side = 2 * _BESIDE_PX + 1
        around = np.asarray(cv2.dilate(mask, np.ones((side, side), np.uint8)), np.uint8)
        held = np.count_nonzero(self._judged & around)
        return held / total - np.count_nonzero(mask) / mask.size

    def cuts(self) -> list[Mask]:
        """What lies among sharp outlines: the largest piece for every sharpness and every gap bridged."""
        out = []
        for share in _SHARP_SHARES:
            sharp = _without_specks((self._step > share).astype(np.uint8))
            if sharp.any():
                out += [cut for cut in self._bridged(sharp) if cut is not None]
        return out

    @cached_property
    def _judged(self) -> Mask:
        sharp = (self._step > _SHARP_SHARES[_JUDGED]).astype(np.uint8)
        return (cv2.resize(255 * sharp, self._size, interpolation=cv2.INTER_AREA) > 63).astype(np.uint8)

    def _bridged(self, sharp: Mask) -> list[Mask | None]:
        """A 0/1 picture closed by discs of growing radius and filled; distances do for all of them."""
        radii = [max(1.0, radius * self._scale) for radius in _BRIDGED_PX]
        margin = int(radii[-1]) + 1
        padded = cv2.copyMakeBorder(1 - sharp, *(margin,) * 4, cv2.BORDER_CONSTANT, value=1)
        distance = cv2.distanceTransform(padded, cv2.DIST_L2, 3)
        out: list[Mask | None] = []
        for radius in radii:
            grown = (distance <= radius).astype(np.uint8)
            closed = cv2.distanceTransform(grown, cv2.DIST_L2, 3)[margin:-margin, margin:-margin] > radius
            filled = fill_holes(closed.astype(np.uint8), np.inf)
            body = tidy(np.asarray(cv2.morphologyEx(filled, cv2.MORPH_OPEN, _K3), np.uint8), None)
            small = body is None or np.count_nonzero(body) < _MIN_AREA_PX * self._scale**2
            out.append(None if body is None or small else self._reduced(body))
        return out

    def _reduced(self, mask: Mask) -> Mask:
        return (cv2.resize(255 * mask, self._size, interpolation=cv2.INTER_AREA) > 127).astype(np.uint8)


def _without_specks(sharp: Mask) -> Mask:
    _, label, stats, _ = cv2.connectedComponentsWithStats(cv2.dilate(sharp, _K3), connectivity=8)
    keep = (stats[:, cv2.CC_STAT_AREA] >= _SPECK_PX).astype(np.uint8)
    keep[0] = 0
    return sharp & keep[label]
