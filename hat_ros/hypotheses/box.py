"""A silhouette from a box: cut the target out of its surroundings by colour, as far as the image allows."""

from __future__ import annotations

import cv2
import numpy as np

from hat_ros.array_types import Bool, UInt8
from hat_ros.segmentation.boundary import refine_outline
from hat_ros.segmentation.region import ColorModels, graph_cut, tidy

# Surroundings kept around the box as the example of background, as a share of its longer side.
_SURROUNDINGS = 0.15
_WORK_SIDE_PX = 128
# A box without this range of grey levels shows nothing to cut.
_MIN_RANGE = 24
_OUTLINE_BAND_PX = 3
_OUTLINE_CONTRAST = 10.0
_MIN_AREA_PX = 30
_ITERATIONS = 3


def silhouette_in_box(rgb: UInt8, box_mask: Bool) -> Bool | None:
    """The target's silhouette inside a box, or None when nothing stands out there.

    Args:
        rgb: (H, W, 3) image.
        box_mask: (H, W) bool, the filled box.
    """
    rows, cols = np.flatnonzero(box_mask.any(axis=1)), np.flatnonzero(box_mask.any(axis=0))
    margin = int(np.ceil(_SURROUNDINGS * max(np.ptp(rows), np.ptp(cols)))) + 2
    height, width = box_mask.shape
    y0, y1 = max(rows[0] - margin, 0), min(rows[-1] + 1 + margin, height)
    x0, x1 = max(cols[0] - margin, 0), min(cols[-1] + 1 + margin, width)
    crop = np.ascontiguousarray(rgb[y0:y1, x0:x1])
    if int(crop.max()) - int(crop.min()) < _MIN_RANGE:
        return None
    scale = min(1.0, _WORK_SIDE_PX / max(crop.shape[:2]))
    size = (max(8, round(crop.shape[1] * scale)), max(8, round(crop.shape[0] * scale)))
    inside = cv2.resize(box_mask[y0:y1, x0:x1].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    labels = np.where(inside > 0, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    reduced = np.asarray(cv2.resize(crop, size, interpolation=cv2.INTER_AREA), np.uint8)
    cut = graph_cut(reduced, labels, ColorModels(), _ITERATIONS)
    cut = None if cut is None else tidy(cut, None)
    if cut is None:
        return None
    mask = np.zeros((height, width), np.uint8)
    mask[y0:y1, x0:x1] = cv2.resize(cut, (x1 - x0, y1 - y0), interpolation=cv2.INTER_LINEAR)
    mask &= box_mask
    band = max(_OUTLINE_BAND_PX, round(1.5 / scale))
    found = (refine_outline(rgb, mask, band, _OUTLINE_CONTRAST) > 0) & box_mask
    return found if np.count_nonzero(found) >= _MIN_AREA_PX else None
