"""Size and rows of an Image message, checked."""

from __future__ import annotations

from typing import Any

import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.errors import FrameError
from hat_ros.types import MAX_IMAGE_SIDE_PX


def checked_size(message: Any) -> tuple[int, int]:
    """(width, height) of an Image message.

    Raises:
        FrameError: an absurd size.
    """
    height, width = int(message.height), int(message.width)
    if not (0 < height <= MAX_IMAGE_SIDE_PX and 0 < width <= MAX_IMAGE_SIDE_PX):
        raise FrameError(f"image size must be 1 to {MAX_IMAGE_SIDE_PX} px a side, found {width}x{height}")
    return width, height


def pixels_of(message: Any, bytes_per_pixel: int) -> UInt8:
    """(H, W, bytes) uint8 view of an Image message's data, row padding left out.

    Raises:
        FrameError: an absurd size, or data that do not fit it.
    """
    (width, height), step = checked_size(message), int(message.step)
    row = width * bytes_per_pixel
    if step < row:
        raise FrameError(f"image step must be at least {row} bytes ({message.encoding}), found {step}")
    if len(message.data) != step * height:
        raise FrameError(f"image of {height} rows of {step} bytes needs {step * height}, found {len(message.data)}")
    rows = np.frombuffer(message.data, dtype=np.uint8).reshape(height, step)
    return rows[:, :row].reshape(height, width, bytes_per_pixel)
