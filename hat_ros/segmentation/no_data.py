"""Borders of exact zeros around an image: a rotated, rectified or letterboxed picture has no data there.

Before a sky that is not zero itself such a border passes for the sky, and the sky's floor for the target. So the border
is filled with pixels of the sky beside it. An ordinary black sky, whose own zeros reach the border, is left as it is.

So is an image whose target lies along more than a tenth of such a border: filled with sky, it would end in a straight
edge that is none of the target's. A border cuts a target off as the edge of the image does, but nothing after
segmentation can be told where the picture ends.
"""

from __future__ import annotations

import cv2
import numpy as np

from hat_ros.array_types import Bool, UInt8
from hat_ros.segmentation.sky import SKY_MAX, level_and_noise

_QUICK_SIDE_PX = 400  # longer side of the image on which most images are found to have no such border
_OPENED_PX = 7  # no data is solid: zeros of a noisy sky are not
_MIN_SHARE = 0.002  # of the image
_EDGE_PX = 3  # beside it what was interpolated is neither
_BESIDE_PX = 12  # so far from it the sky is looked at
_NOISE_SIGMAS, _MIN_STEP, _MAX_STEP = 5.0, 1.5, 20.0
# Of the sky beside it is within its noise; of the whole picture is; of the picture's convex hull is picture: a target
# before a sky of zeros is not so flat, or not so compact.
_MIN_FLAT, _MIN_SKY, _MIN_SOLID = 0.9, 0.3, 0.7  # a rectified picture has hollow sides
_MAX_ZERO = 0.2  # of the sky beside it is zero
_MIN_LIT_PX = 40  # of something brighter than that sky


def with_sky_in_borders(rgb: UInt8) -> UInt8:
    """An (H, W, 3) uint8 image with sky where a border of exact zeros was; without one the very same image."""
    step = -(-max(rgb.shape) // _QUICK_SIDE_PX)
    empty = None if _no_data(rgb[::step, ::step]) is None else _no_data(rgb)
    if empty is None:
        return rgb
    kernel = np.ones((2 * _EDGE_PX + 1,) * 2, np.uint8)
    filled = cv2.dilate(empty, kernel).view(np.bool_)
    beside = cv2.dilate(empty, np.ones((2 * _BESIDE_PX + 1,) * 2, np.uint8)).view(np.bool_) & ~filled
    luma = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    sky = _sky_beside(luma, beside, ~filled)
    if sky is None:
        return rgb
    found = rgb[sky]
    out = rgb.copy()
    # Any pixels of the sky will do, in no order that the eye or a filter can see; the same ones every time.
    out[filled] = found[np.random.default_rng(0).integers(0, len(found), np.count_nonzero(filled))]
    return out


def _no_data(rgb: UInt8) -> UInt8 | None:
    """Solid zeros connected to the image border, (H, W) 0/1; None when there are hardly any."""
    edges = np.concatenate([rgb[0], rgb[-1], rgb[:, 0], rgb[:, -1]])
    if np.count_nonzero(~edges.any(axis=1)) < _MIN_SHARE * len(edges):
        return None
    brightest = np.asarray(cv2.max(cv2.max(rgb[..., 0], rgb[..., 1]), rgb[..., 2]), np.uint8)
    zero = (brightest == 0).astype(np.uint8)
    # Beyond the image it goes on: a border of a few pixels is solid, too.
    room = cv2.copyMakeBorder(zero, *(_OPENED_PX,) * 4, cv2.BORDER_REPLICATE)
    solid = cv2.morphologyEx(room, cv2.MORPH_OPEN, np.ones((_OPENED_PX,) * 2, np.uint8))
    solid = np.ascontiguousarray(solid[_OPENED_PX:-_OPENED_PX, _OPENED_PX:-_OPENED_PX])
    _, label = cv2.connectedComponents(solid, connectivity=4)
    at_border = np.unique(np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]]))
    empty = np.isin(label, at_border[at_border > 0]).astype(np.uint8)
    share = np.count_nonzero(empty) / empty.size
    if not _MIN_SHARE <= share < 1 - _MIN_SHARE:
        return None
    outline = cv2.convexHull(cv2.findNonZero(1 - empty))
    return empty if (1 - share) * empty.size >= _MIN_SOLID * cv2.contourArea(outline) else None


def _sky_beside(luma: UInt8, beside: Bool, picture: Bool) -> Bool | None:
    """The (H, W) sky pixels beside the border; None unless a flat sky is there, not of zeros, and something is lit."""
    values = luma[beside].astype(np.float32)
    if len(values) < _MIN_LIT_PX or np.count_nonzero(values == 0) > _MAX_ZERO * len(values):
        return None
    level, sigma = level_and_noise(values)
    step = max(_NOISE_SIGMAS * sigma, _MIN_STEP)
    flat = np.abs(luma - np.float32(level)) <= step
    if not 0 < level < SKY_MAX or step > _MAX_STEP or np.count_nonzero(flat[beside]) < _MIN_FLAT * len(values):
        return None
    lit = np.count_nonzero(picture & (luma > level + step))
    if lit < _MIN_LIT_PX or np.count_nonzero(flat & picture) < _MIN_SKY * np.count_nonzero(picture):
        return None
    return flat & beside
