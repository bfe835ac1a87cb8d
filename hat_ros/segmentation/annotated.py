"""Detections that come with the recording: ``segmentation.backend: annotated``."""

from __future__ import annotations

import math

import numpy as np

from hat_ros.array_types import Bool
from hat_ros.config import HatConfig
from hat_ros.target.model import Target
from hat_ros.types import MASK_BOX, MASK_SILHOUETTE, Detection, Frame, PosePrior


class AnnotatedSegmenter:
    """Passes on ``Frame.given_mask``: silhouettes as they are, boxes padded by ``segmentation.box_padding``."""

    def __init__(self, config: HatConfig, target: Target) -> None:
        del target
        self._padding = config.segmentation.box_padding

    def update(self, frame: Frame, prior: PosePrior | None) -> Detection | None:
        """The frame's own detection, None when it brings none; ``prior`` is not used."""
        del prior
        given = frame.given_mask
        if given is None:
            return None
        silhouette = given == MASK_SILHOUETTE
        if silhouette.any():
            return Detection(silhouette)
        box = given == MASK_BOX
        if not box.any():
            return None
        return Detection(pad_box(box, self._padding), silhouette=False)

    def reset(self) -> None:
        """Nothing is learned."""


def pad_box(box: Bool, padding: float) -> Bool:
    """The tight box of an (H, W) mask, grown by ``padding`` of its width and height on each side, clipped, filled."""
    rows, cols = np.flatnonzero(box.any(axis=1)), np.flatnonzero(box.any(axis=0))
    out = np.zeros_like(box)
    y0, y1 = _grow(rows[0], rows[-1] + 1, padding, box.shape[0])
    x0, x1 = _grow(cols[0], cols[-1] + 1, padding, box.shape[1])
    out[y0:y1, x0:x1] = True
    return out


def _grow(start: int, stop: int, padding: float, size: int) -> tuple[int, int]:
    margin = math.floor(padding * (stop - start) + 0.5)
    return max(0, int(start) - margin), min(size, int(stop) + margin)
