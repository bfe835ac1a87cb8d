"""YUV images to RGB: BT.601, in the range of video or the full one; pixels that share a colour get the same."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from hat_ros.array_types import Float, UInt8
from hat_ros.errors import FrameError
from hat_ros.io.layout import checked_size, pixels_of
from hat_ros.io.value_range import ValueRange

# Encoding -> place of luma in a pixel's two bytes, the other being U and V in turn.
PACKED_YUV = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
# Encoding -> (rows and columns that share a colour, order of the colours): a plane of luma, then one of colour pairs.
PLANAR_YUV = {"nv12": (2, "uv"), "nv21": (2, "vu"), "nv24": (1, "uv")}


def _matrix(full: bool) -> Float:
    """(3, 4) RGB from (Y, U, V, 1)."""
    colours = np.array([[0.0, 1.402], [-0.344136, -0.714136], [1.772, 0.0]]) * (1.0 if full else 255.0 / 224.0)
    luma, black = (1.0, 0.0) if full else (255.0 / 219.0, 16.0)
    linear = np.column_stack([np.full(3, luma), colours])
    return np.column_stack([linear, -linear @ np.array([black, 128.0, 128.0])])


_TO_RGB = {full: _matrix(full) for full in (False, True)}


def decode_yuv(message: Any, known: ValueRange) -> tuple[UInt8, ValueRange]:
    """(H, W, 3) uint8 RGB of an Image in one of these encodings, and what is known of its range after it.

    Raises:
        FrameError: sizes that do not fit each other.
    """
    yuv = _packed(message) if message.encoding in PACKED_YUV else _planar(message)
    known = known.with_luma(yuv[..., 0])
    return cv2.transform(yuv, _TO_RGB[known.full_luma]).astype(np.uint8, copy=False), known


def _packed(message: Any) -> UInt8:
    """(H, W, 3) Y, U, V of two pixels in four bytes."""
    if message.width % 2:
        raise FrameError(f"image of encoding '{message.encoding}' must have an even width, found {message.width} px")
    pairs, luma = pixels_of(message, 2), PACKED_YUV[message.encoding]
    colour = pairs[..., 1 - luma]
    return np.dstack([pairs[..., luma], np.repeat(colour[:, 0::2], 2, axis=1), np.repeat(colour[:, 1::2], 2, axis=1)])


def _planar(message: Any) -> UInt8:
    """(H, W, 3) Y, U, V of two planes.

    Drivers disagree on ``step`` (bytes of a row of luma, or of a row of all planes together); the length of the data
    tells how long a row is.
    """
    shared, order = PLANAR_YUV[message.encoding]
    (width, height), size = checked_size(message), len(message.data)
    bytes_per_pixel = 1.0 + 2.0 / shared**2
    stride = int(size / (height * bytes_per_pixel))
    if width % shared or height % shared or stride < width or stride * height * bytes_per_pixel != size:
        raise FrameError(
            f"image of encoding '{message.encoding}' must have sides that are multiples of {shared} px and "
            f"{bytes_per_pixel:g} bytes per pixel in whole rows, found {width}x{height} px and {size} bytes"
        )
    data = np.frombuffer(message.data, dtype=np.uint8)
    luma, colours = data[: stride * height].reshape(height, stride)[:, :width], data[stride * height :]
    pairs = colours.reshape(height // shared, -1)[:, : 2 * width // shared].reshape(height // shared, -1, 2)
    spread = pairs.repeat(shared, axis=0).repeat(shared, axis=1)
    return np.dstack([luma, spread if order == "uv" else spread[..., ::-1]])
