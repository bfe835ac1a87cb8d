"""Pixels: ROS image encodings and compressed images to rgb8, and the mask in the alpha channel of ``/hat/frame``.

The player's path (raw bytes through DDS, decoded by the segmentation node) and the in-process path (decoded by the bag
reader) both end here, so both see the same pixels.
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import UInt8
from hat_ros.errors import FrameError
from hat_ros.types import MASK_BOX, MASK_SILHOUETTE, MAX_IMAGE_SIDE_PX, Detection

# 1 for all values that a mask may not hold: looked up five times faster than compared.
_NO_MASK_VALUE = np.ones(256, np.uint8)
_NO_MASK_VALUE[[0, MASK_BOX, MASK_SILHOUETTE]] = 0

# encoding -> (channels, cv2 conversion to RGB or None). A ROS Bayer name gives the first two pixels of the first row,
# an OpenCV one those of the second row from the second column on: hence the crossed pairs.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
}
_ENCODINGS_16 = ("mono16", "16UC1")


def decode_image(message: Any) -> UInt8:
    """(H, W, 3) uint8 RGB of an Image or CompressedImage message.

    16-bit grey keeps its upper byte. Compressed images are JPEG or PNG.

    Raises:
        FrameError: unknown encoding, sizes that do not fit each other, or data that cannot be decoded.
    """
    if hasattr(message, "format"):
        return _decode_compressed(bytes(message.data))
    encoding = message.encoding
    if encoding in _ENCODINGS_16:
        raw = pixels_of(message, 2)
        return _converted(raw[..., 0 if message.is_bigendian else 1], cv2.COLOR_GRAY2RGB)
    if encoding not in _ENCODINGS:
        known = ", ".join((*_ENCODINGS, *_ENCODINGS_16))
        raise FrameError(f"image encoding '{encoding}' is not supported, use one of {known}")
    channels, conversion = _ENCODINGS[encoding]
    raw = pixels_of(message, channels)
    if conversion is None:
        return np.ascontiguousarray(raw)
    return _converted(raw[..., 0] if channels == 1 else raw, conversion)


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


def pixels_of(message: Any, channels: int) -> UInt8:
    """(H, W, C) uint8 view of an Image message's data, row padding left out."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    if not (0 < height <= MAX_IMAGE_SIDE_PX and 0 < width <= MAX_IMAGE_SIDE_PX):
        raise FrameError(f"image size must be 1 to {MAX_IMAGE_SIDE_PX} px a side, found {width}x{height}")
    if step < width * channels:
        raise FrameError(f"image step must be at least {width * channels} bytes ({message.encoding}), found {step}")
    if len(message.data) != step * height:
        raise FrameError(f"image of {height} rows of {step} bytes needs {step * height}, found {len(message.data)}")
    rows = np.frombuffer(message.data, dtype=np.uint8).reshape(height, step)
    return rows[:, : width * channels].reshape(height, width, channels)


def _decode_compressed(data: bytes) -> UInt8:
    width, height = _declared_size(data)
    if not (0 < height <= MAX_IMAGE_SIDE_PX and 0 < width <= MAX_IMAGE_SIDE_PX):
        raise FrameError(f"compressed image must be 1 to {MAX_IMAGE_SIDE_PX} px a side, found {width}x{height}")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        bgr = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as error:
        raise FrameError(f"compressed image cannot be decoded ({error.err})") from None
    if bgr is None:
        raise FrameError("compressed image cannot be decoded: the data are damaged")
    return _converted(bgr, cv2.COLOR_BGR2RGB)


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


def _declared_size(data: bytes) -> tuple[int, int]:
    """(width, height) from the file's header, before a decoder allocates anything from it."""
    try:
        if data[:8] == b"\x89PNG\r\n\x1a\n":
            return struct.unpack(">II", data[16:24])
        if data[:2] == b"\xff\xd8":
            return _jpeg_size(data)
    except (struct.error, IndexError):
        raise FrameError("compressed image ends within its header") from None
    raise FrameError("compressed image is neither JPEG nor PNG")


def _jpeg_size(data: bytes) -> tuple[int, int]:
    at = 2
    while True:
        if data[at] != 0xFF:
            raise FrameError("compressed image is a damaged JPEG")
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        (length,) = struct.unpack(">H", data[at + 2 : at + 4])
        at += 2 + length


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
