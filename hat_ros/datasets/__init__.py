"""Recordings: camera frames of one target with their calibration, and the truth where it is known.

Whatever a clip was stored as (bag, sequence folder, data set), what reads it is a :class:`Recording`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hat_ros.types import Camera, Frame


class Recording(Protocol):
    """One clip. The truth is for evaluation: no stage of the method may see it."""

    @property
    def camera(self) -> Camera:
        """Calibration of all frames."""
        ...

    @property
    def target_path(self) -> Path:
        """CAD model, or the ``target.yaml`` that names it: what ``load_target`` reads."""
        ...

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def frames(self, limit: int | None = None) -> Iterator[Frame]:
        """The frames in stamp order, at most ``limit`` of them."""
        ...

    def truth(self) -> dict[int, NDArray[np.float64]]:
        """Stamp in nanoseconds -> (4, 4) true ``T_cam_target``; empty when unknown."""
        ...
