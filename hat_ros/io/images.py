"""Pixels: ROS image encodings and compressed images to rgb8, and the mask in the alpha channel of ``/hat/frame``.

The player's path (raw bytes through DDS, decoded by the segmentation node) and the in-process path (decoded by the bag
reader) both end here, so both see the same pixels.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import UInt8
from hat_ros.errors import FrameError
from hat_ros.io.compressed import decode_compressed
from hat_ros.io.encodings import decode_raw
from hat_ros.io.layout import pixels_of
from hat_ros.io.value_range import ValueRange
from hat_ros.types import MASK_BOX, MASK_SILHOUETTE, Detection

NOTHING_KNOWN = ValueRange()

# 1 for all values that a mask may not hold: looked up five times faster than compared.
_NO_MASK_VALUE = np.ones(256, np.uint8)
_NO_MASK_VALUE[[0, MASK_BOX, MASK_SILHOUETTE]] = 0


def decode_image(message: Any, known: ValueRange = NOTHING_KNOWN) -> tuple[UInt8, ValueRange]:
    """(H, W, 3) uint8 RGB of an Image or CompressedImage message, and what is known of its range of values after it.

    Args:
        message: any encoding of :mod:`hat_ros.io.encodings`, or a file of :mod:`hat_ros.io.compressed`.
        known: the range of values as known before this image.

    Raises:
        FrameError: unknown encoding, sizes that do not fit each other, or data that cannot be decoded.
    """
    if hasattr(message, "format"):
        return decode_compressed(bytes(message.data), known)
    return decode_raw(message, known)


def decode_mask(message: Any) -> UInt8 | None:
    """(H, W) uint8 of a ``/detection/mask`` message (mono8), None for an empty one: no detection in this frame.

    Raises:
        FrameError: not mono8, sizes that do not fit, or values other than 0, 128 and 255.
    """
    if message.height == 0 and message.width == 0:
        return None
    if message.encoding not in ("mono8", "8UC1"):
        raise FrameError(f"detection mask must be mono8, found '{message.encoding}'")
    mask = np.ascontiguousarray(pixels_of(message, 1)[..., 0])
    if cv2.LUT(mask, _NO_MASK_VALUE).any():
        raise FrameError(f"detection mask may hold 0, {MASK_BOX} (box) and {MASK_SILHOUETTE} (silhouette) only")
    return mask


def _converted(pixels: NDArray, conversion: int) -> UInt8:
    """OpenCV's colour conversion of uint8 pixels, which gives uint8."""
    return cv2.cvtColor(np.ascontiguousarray(pixels), conversion).astype(np.uint8, copy=False)


def encode_image(rgb: UInt8, image_format: str, jpeg_quality: int = 95) -> bytes:
    """(H, W, 3) uint8 RGB as the bytes of an image file.

    Args:
        rgb: the image.
        image_format: ``png`` or ``jpeg``.
        jpeg_quality: 1 to 100.
    """
    bgr = _converted(rgb, cv2.COLOR_RGB2BGR)
    if image_format == "png":
        return cv2.imencode(".png", bgr)[1].tobytes()
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])[1].tobytes()


def rgba_from(rgb: UInt8, detection: Detection | None) -> UInt8:
    """(H, W, 4) uint8: the image with its detection as alpha.

    255 = target silhouette, 128 = inside a box whose silhouette is unknown, 0 = outside; 0 everywhere = no detection.
    """
    rgba = _converted(rgb, cv2.COLOR_RGB2RGBA)
    if detection is None:
        rgba[..., 3] = 0
    else:
        rgba[..., 3] = detection.mask * np.uint8(MASK_SILHOUETTE if detection.silhouette else MASK_BOX)
    return rgba


def split_rgba(rgba: UInt8) -> tuple[UInt8, Detection | None]:
    """Inverse of :func:`rgba_from`.

    Raises:
        FrameError: alpha holds anything but one of the two mask values.
    """
    rgba = np.ascontiguousarray(rgba)
    rgb = _converted(rgba, cv2.COLOR_RGBA2RGB)
    alpha = np.ascontiguousarray(rgba[..., 3])
    mask = alpha != 0
    value = int(alpha.max())
    if value == 0:
        return rgb, None
    if value not in (MASK_BOX, MASK_SILHOUETTE) or np.count_nonzero(alpha == value) != np.count_nonzero(mask):
        values = f"{MASK_BOX} (box) or {MASK_SILHOUETTE} (silhouette)"
        raise FrameError(f"alpha must be 0 and either {values}, found up to {value}")
    return rgb, Detection(mask, value == MASK_SILHOUETTE)
