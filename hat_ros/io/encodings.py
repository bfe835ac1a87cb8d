"""Raw pixels: the encodings of ``sensor_msgs/Image`` to rgb8.

``docs/cameras.md`` lists them; a test compares the list with :func:`encoding_names`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.errors import FrameError
from hat_ros.io.layout import pixels_of
from hat_ros.io.value_range import ValueRange
from hat_ros.io.yuv import PACKED_YUV, PLANAR_YUV, decode_yuv


class Encoding(NamedTuple):
    """How pixels stand in the message.

    Attributes:
        channels: values per pixel.
        to_rgb: OpenCV's conversion to RGB, None for what is RGB already.
        wide: values have 16 bits, in the byte order of ``is_bigendian``.
    """

    channels: int
    to_rgb: int | None
    wide: bool = False


# A ROS Bayer name gives the first two pixels of the first row, an OpenCV one those of the second row from the second
# column on: hence the crossed pairs.
_BAYER = {
    "rggb": cv2.COLOR_BayerBG2RGB,
    "bggr": cv2.COLOR_BayerRG2RGB,
    "gbrg": cv2.COLOR_BayerGR2RGB,
    "grbg": cv2.COLOR_BayerGB2RGB,
}
_NARROW: dict[str, Encoding] = {
    "rgb8": Encoding(3, None),
    "bgr8": Encoding(3, cv2.COLOR_BGR2RGB),
    "8UC3": Encoding(3, cv2.COLOR_BGR2RGB),
    "rgba8": Encoding(4, cv2.COLOR_RGBA2RGB),
    "bgra8": Encoding(4, cv2.COLOR_BGRA2RGB),
    "8UC4": Encoding(4, cv2.COLOR_BGRA2RGB),
    "mono8": Encoding(1, cv2.COLOR_GRAY2RGB),
    "8UC1": Encoding(1, cv2.COLOR_GRAY2RGB),
    **{f"bayer_{pattern}8": Encoding(1, code) for pattern, code in _BAYER.items()},
}


def _wide_name(name: str) -> str:
    """``16UC3`` of ``8UC3``, ``rgb16`` of ``rgb8``."""
    return f"16{name[1:]}" if name[0] == "8" else f"{name[:-1]}16"


_ENCODINGS = _NARROW | {_wide_name(name): found._replace(wide=True) for name, found in _NARROW.items()}


def encoding_names() -> tuple[str, ...]:
    """Every encoding that is read."""
    return (*_ENCODINGS, *PACKED_YUV, *PLANAR_YUV)


def decode_raw(message: Any, known: ValueRange) -> tuple[UInt8, ValueRange]:
    """(H, W, 3) uint8 RGB of an Image message, and what is known of its range of values after it.

    Raises:
        FrameError: unknown encoding, or sizes that do not fit each other.
    """
    name = message.encoding
    if name in PACKED_YUV or name in PLANAR_YUV:
        return decode_yuv(message, known)
    if name not in _ENCODINGS:
        raise FrameError(f"image encoding '{name}' is not supported, use one of {', '.join(encoding_names())}")
    channels, to_rgb, wide = _ENCODINGS[name]
    values = pixels_of(message, 2 * channels if wide else channels)
    if wide:
        order = ">u2" if message.is_bigendian else "<u2"
        values, known = known.narrow(np.ascontiguousarray(values).view(order).astype(np.uint16, copy=False))
    if to_rgb is None:
        return np.ascontiguousarray(values), known
    planes = np.ascontiguousarray(values[..., 0] if channels == 1 else values)
    return cv2.cvtColor(planes, to_rgb).astype(np.uint8, copy=False), known
