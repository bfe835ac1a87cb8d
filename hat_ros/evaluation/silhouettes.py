"""How well detected silhouettes cover recorded ones: judged after a run, so that no time of the run goes into it."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray

from hat_ros.segmentation.masks import overlap
from hat_ros.tracker import Step

_FASTEST = 1  # compression; a silhouette takes a kilobyte


class Silhouettes:
    """What was detected in the frames of a run: compressed, in a file of its own, since memory must not grow."""

    def __init__(self) -> None:
        self._file = TemporaryFile()  # noqa: SIM115 - closed by close()
        self._packed: dict[int, tuple[int, int] | None] = {}  # place and length by stamp

    def close(self) -> None:
        """Forget everything."""
        self._file.close()

    def remember(self, step: Step) -> None:
        """Keep the mask of a frame that was looked at, or that there was none."""
        place = None
        if step.detection is not None:
            packed = zlib.compress(np.packbits(step.detection.mask).tobytes(), _FASTEST)
            place = self._file.tell(), len(packed)
            self._file.write(packed)
        self._packed[step.estimate.stamp_ns] = place

    def overlaps(self, recorded: Iterable[tuple[int, NDArray[np.uint8] | None]]) -> dict[int, float]:
        """Stamp -> intersection over union, 0 for a target that was missed; frames that show no silhouette left out.

        To be asked for after the last frame.

        Args:
            recorded: stamps and masks, (H, W) uint8 as in ``Frame.given_mask``.
        """
        out: dict[int, float] = {}
        for stamp_ns, given in recorded:
            if given is None or stamp_ns in out or stamp_ns not in self._packed:
                continue
            silhouette = given == 255
            if silhouette.any():
                place = self._packed[stamp_ns]
                out[stamp_ns] = 0.0 if place is None else overlap(self._detected(*place, given.shape), silhouette)
        return out

    def _detected(self, start: int, length: int, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        self._file.seek(start)
        packed = np.frombuffer(zlib.decompress(self._file.read(length)), np.uint8)
        return np.unpackbits(packed, count=shape[0] * shape[1]).reshape(shape).astype(bool)
