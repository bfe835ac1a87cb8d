"""How well detected silhouettes cover recorded ones: judged after a run, so that no time of the run goes into it."""

from __future__ import annotations

import zlib
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from hat_ros.segmentation.masks import overlap
from hat_ros.tracker import Step

_FASTEST = 1  # compression; a silhouette takes a kilobyte


class Silhouettes:
    """What was detected in the frames of a run, compressed."""

    def __init__(self) -> None:
        self._packed: dict[int, bytes | None] = {}

    def remember(self, step: Step) -> None:
        """Keep the mask of a frame that was looked at, or that there was none."""
        mask = None if step.detection is None else step.detection.mask
        packed = None if mask is None else zlib.compress(np.packbits(mask).tobytes(), _FASTEST)
        self._packed[step.estimate.stamp_ns] = packed

    def overlaps(self, recorded: Iterable[tuple[int, NDArray[np.uint8] | None]]) -> dict[int, float]:
        """Stamp -> intersection over union, 0 for a target that was missed; frames that show no silhouette left out.

        Args:
            recorded: stamps and masks, (H, W) uint8 as in ``Frame.given_mask``.
        """
        out: dict[int, float] = {}
        for stamp_ns, given in recorded:
            if given is None or stamp_ns in out or stamp_ns not in self._packed:
                continue
            silhouette = given == 255
            if silhouette.any():
                packed = self._packed[stamp_ns]
                out[stamp_ns] = 0.0 if packed is None else overlap(_unpacked(packed, given.shape), silhouette)
        return out


def _unpacked(packed: bytes, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    bits = np.unpackbits(np.frombuffer(zlib.decompress(packed), np.uint8), count=shape[0] * shape[1])
    return bits.reshape(shape).astype(bool)
