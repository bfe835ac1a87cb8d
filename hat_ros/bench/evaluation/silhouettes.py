"""How well detected silhouettes cover recorded ones: judged after a run, so that no time of the run goes into it."""

from __future__ import annotations

from collections.abc import Iterable
from tempfile import TemporaryFile

import cv2
import numpy as np

from hat_ros.array_types import Bool, UInt8
from hat_ros.target.masks import overlap
from hat_ros.tracker import Step

Box = tuple[int, int, int, int]  # left, top, width, height


class Silhouettes:
    """What was detected in the frames of a run: a bit a pixel of its box, in a file, since memory must not grow."""

    def __init__(self) -> None:
        self._file = TemporaryFile()  # noqa: SIM115 - closed by close()
        self._places: dict[int, tuple[int, Box] | None] = {}  # in the file and in the image, by stamp

    def close(self) -> None:
        """Forget everything."""
        self._file.close()

    def remember(self, step: Step) -> None:
        """Keep the mask of a frame that was looked at, or that there was none."""
        place = None
        if step.detection is not None:
            mask = step.detection.mask
            left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
            box = left, top, width, height
            place = self._file.tell(), box
            self._file.write(np.packbits(mask[_within(box)]).tobytes())
        self._places[step.estimate.stamp_ns] = place

    def overlaps(self, recorded: Iterable[tuple[int, UInt8 | None]]) -> dict[int, float]:
        """Stamp -> intersection over union, 0 for a target that was missed; frames that show no silhouette left out.

        To be asked for after the last frame.

        Args:
            recorded: stamps and masks, (H, W) uint8 as in ``Frame.given_mask``.
        """
        out: dict[int, float] = {}
        for stamp_ns, given in recorded:
            if given is None or stamp_ns in out or stamp_ns not in self._places:
                continue
            silhouette = given == 255
            if silhouette.any():
                place = self._places[stamp_ns]
                out[stamp_ns] = 0.0 if place is None else overlap(self._detected(*place, given.shape), silhouette)
        return out

    def _detected(self, start: int, box: Box, shape: tuple[int, ...]) -> Bool:
        _, _, width, height = box
        self._file.seek(start)
        packed = np.frombuffer(self._file.read(-(-width * height // 8)), np.uint8)
        mask = np.zeros(shape, bool)
        mask[_within(box)] = np.unpackbits(packed, count=width * height).reshape(height, width)
        return mask


def _within(box: Box) -> tuple[slice, slice]:
    left, top, width, height = box
    return np.s_[top : top + height, left : left + width]
