"""Compressed pixels: JPEG, PNG, WebP and TIFF files to rgb8, their size known before a decoder allocates anything."""

from __future__ import annotations

import io
import struct
import warnings

import cv2
import numpy as np
from PIL import Image

from hat_ros.array_types import UInt8
from hat_ros.errors import FrameError
from hat_ros.io import jpeg
from hat_ros.io.value_range import ValueRange
from hat_ros.types import MAX_IMAGE_SIDE_PX

FORMATS = ("jpeg", "png", "webp", "tiff")
_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
_TIFF_ORDER = {b"II*\0": "<", b"MM\0*": ">"}
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_TIFF_SHORT, _TIFF_LONG = 3, 4
_MAX_TIFF_TAGS = 512


def decode_compressed(data: bytes, known: ValueRange) -> tuple[UInt8, ValueRange]:
    """(H, W, 3) uint8 RGB of an image file, and what is known of its range of values after it.

    Raises:
        FrameError: another format, an absurd size, values of other than 8 or 16 bits, or damaged data.
    """
    width, height = _declared_size(data)
    if not (0 < height <= MAX_IMAGE_SIDE_PX and 0 < width <= MAX_IMAGE_SIDE_PX):
        raise FrameError(f"compressed image must be 1 to {MAX_IMAGE_SIDE_PX} px a side, found {width}x{height}")
    check_pixels(data)
    if data[:2] == jpeg.SOI and not data.endswith(jpeg.EOI):
        data += jpeg.EOI  # some cameras leave it out: all pixels are there, but OpenCV would wait for more
    try:
        bgr = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), _FLAGS)
    except cv2.error as error:
        raise FrameError(f"compressed image cannot be decoded ({error.err})") from None
    if bgr is None:
        raise FrameError("compressed image cannot be decoded: the data are damaged")
    if bgr.dtype == np.uint16:
        bgr, known = known.narrow(bgr.astype(np.uint16, copy=False))
    if bgr.dtype != np.uint8:
        raise FrameError(f"compressed image must have 8 or 16 bits per value, found {bgr.dtype}")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False), known


def check_pixels(data: bytes) -> None:
    """Refuse damage that OpenCV notices and passes over, or does not notice: of JPEG and of compressed TIFF files.

    Raises:
        FrameError: what the file holds is not the picture that was written.
    """
    if data[:2] == jpeg.SOI:
        jpeg.check_jpeg(data)
    elif data[:4] in _TIFF_ORDER:
        _check_tiff(data)


def _check_tiff(data: bytes) -> None:
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(data)) as image:
            image.load()
    except Exception as error:
        # Pillow knows fewer kinds of TIFF than OpenCV, which decides about those.
        if isinstance(error, OSError) and "decoder error" in str(error):
            raise FrameError("compressed image is a damaged TIFF") from None


def _declared_size(data: bytes) -> tuple[int, int]:
    """(width, height) from the file's header."""
    try:
        if data[:8] == b"\x89PNG\r\n\x1a\n":
            width, height = struct.unpack(">II", data[16:24])
            return width, height
        if data[:2] == jpeg.SOI:
            return jpeg.jpeg_size(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp_size(data)
        if data[:4] in _TIFF_ORDER:
            return _tiff_size(data, _TIFF_ORDER[data[:4]])
    except (struct.error, IndexError):
        raise FrameError("compressed image ends within its header") from None
    raise FrameError("compressed image is neither JPEG, PNG, WebP nor TIFF")


def _webp_size(data: bytes) -> tuple[int, int]:
    """Of the first chunk: lossy, lossless, or extended."""
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = struct.unpack("<HH", data[26:30])
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack("<I", data[21:25])
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        low, high, low_2, high_2 = struct.unpack("<HBHB", data[24:30])
        return low + (high << 16) + 1, low_2 + (high_2 << 16) + 1
    raise FrameError("compressed image is a damaged WebP")


def _tiff_size(data: bytes, order: str) -> tuple[int, int]:
    """Of the first image."""
    (at,) = struct.unpack(f"{order}I", data[4:8])
    (count,) = struct.unpack(f"{order}H", data[at : at + 2])
    found: dict[int, int] = {}
    for index in range(min(count, _MAX_TIFF_TAGS)):
        entry = data[at + 2 + 12 * index : at + 14 + 12 * index]
        tag, kind = struct.unpack(f"{order}HH", entry[:4])
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT) and kind in (_TIFF_SHORT, _TIFF_LONG):
            width = 2 if kind == _TIFF_SHORT else 4
            (found[tag],) = struct.unpack(f"{order}{'H' if width == 2 else 'I'}", entry[8 : 8 + width])
    if len(found) < 2:
        raise FrameError("compressed image is a damaged TIFF")
    return found[_TIFF_WIDTH], found[_TIFF_HEIGHT]
