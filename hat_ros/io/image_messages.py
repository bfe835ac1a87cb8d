"""Images and calibrations as messages, and back; pixels are the business of :mod:`hat_ros.io.images`."""

from __future__ import annotations

from typing import Any

import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.errors import FrameError, HatError, WireError
from hat_ros.io import images
from hat_ros.io.layout import pixels_of
from hat_ros.io.lens import Lens
from hat_ros.io.message_family import MessageFamily
from hat_ros.types import Camera, Detection


class ImageWire(MessageFamily):
    """Encodes images and calibrations."""

    def camera_info(self, stamp_ns: int, frame_id: str, camera: Camera, lens: Lens | None = None) -> Any:
        """CameraInfo of a camera; with a lens, of its raw images, whose rectified ones have the same matrix."""
        K = camera.K
        roi = self._class("sensor_msgs/msg/RegionOfInterest")(
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._class("sensor_msgs/msg/CameraInfo")(
            header=self.header(stamp_ns, frame_id),
            height=int(camera.height),
            width=int(camera.width),
            distortion_model="plumb_bob" if lens is None else lens.model,
            d=self._numbers([0.0] * 5 if lens is None else lens.coefficients.tolist()),
            k=K.ravel().copy(),
            r=np.eye(3).ravel(),
            p=np.column_stack([K, np.zeros(3)]).ravel(),
            binning_x=0,
            binning_y=0,
            roi=roi,
        )

    def image(self, stamp_ns: int, frame_id: str, encoding: str, pixels: UInt8) -> Any:
        """Image of (H, W) or (H, W, C) uint8 pixels."""
        pixels = np.ascontiguousarray(pixels)
        return self._class("sensor_msgs/msg/Image")(
            header=self.header(stamp_ns, frame_id),
            height=int(pixels.shape[0]),
            width=int(pixels.shape[1]),
            encoding=encoding,
            is_bigendian=0,
            step=int(pixels[0].size) if len(pixels) else 0,
            data=self._octets(pixels.data.cast("B") if pixels.size else b""),
        )

    def compressed(self, stamp_ns: int, frame_id: str, image_format: str, data: bytes) -> Any:
        """CompressedImage."""
        return self._class("sensor_msgs/msg/CompressedImage")(
            header=self.header(stamp_ns, frame_id), format=image_format, data=self._octets(data)
        )

    def frame(self, stamp_ns: int, frame_id: str, rgb: UInt8, detection: Detection | None) -> Any:
        """Image of ``/hat/frame``: rgba8, alpha = mask, see :func:`hat_ros.io.images.rgba_from`."""
        return self.image(stamp_ns, frame_id, "rgba8", images.rgba_from(rgb, detection))


def camera_from(message: Any) -> Camera:
    """Decode ``/hat/camera_info``; what a camera sends is decoded by :mod:`hat_ros.io.calibration`.

    Raises:
        FrameError: lens distortion, binning or a region of interest, or an impossible matrix.
    """
    d = np.asarray(message.d, dtype=np.float64)
    if d.size and (not np.isfinite(d).all() or d.any()):
        raise FrameError(f"camera_info.d must be zero, found {d.tolist()}")
    if message.binning_x > 1 or message.binning_y > 1 or message.roi.width or message.roi.height:
        raise FrameError("camera_info must have neither binning nor a region of interest")
    return Camera(np.array(message.k, dtype=np.float64).reshape(3, 3), int(message.width), int(message.height))


def frame_from(message: Any) -> tuple[UInt8, Detection | None]:
    """Decode ``/hat/frame``: (H, W, 3) uint8 and the detection.

    Raises:
        WireError: not rgba8, or alpha is no mask.
    """
    try:
        if message.encoding != "rgba8":
            raise WireError(f"encoding must be rgba8, found '{message.encoding}'")
        return images.split_rgba(pixels_of(message, 4))
    except HatError as error:
        raise WireError(f"/hat/frame: {error}") from None
