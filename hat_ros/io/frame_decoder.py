"""From the messages of one camera to frames: pixels, depth, distortion. The bag reader and the graph use this object.

So both see the same pixels.
"""

from __future__ import annotations

import logging
from typing import Any

from hat_ros.array_types import UInt8
from hat_ros.errors import FrameError
from hat_ros.io.calibration import Calibration
from hat_ros.io.images import decode_image, decode_mask
from hat_ros.io.value_range import ValueRange
from hat_ros.types import Frame

LOG = logging.getLogger(__name__)


class FrameDecoder:
    """Decodes the frames of one run in order.

    Args:
        calibration: of all its images.
        image_depth: option ``camera.image_depth``.
        quiet: do not log what was chosen: an earlier pass over the same images did.

    Attributes:
        calibration: as given.
    """

    def __init__(self, calibration: Calibration, image_depth: str, quiet: bool = False) -> None:
        self.calibration = calibration
        self._known = ValueRange.of_option(image_depth)
        self._newest_ns = 0
        self._quiet = quiet
        if calibration.said and not quiet:
            LOG.info(calibration.said)

    def frame(self, stamp_ns: int, image: Any, mask: Any | None = None) -> Frame:
        """One frame.

        The range of values is learned from frames that are whole and later than those before, which are the
        frames that a graph admits.

        Args:
            stamp_ns: its stamp.
            image: Image or CompressedImage.
            mask: the given detection as an Image, None = there is none.

        Raises:
            FrameError: image or mask is malformed, or has another size than the calibration says.
        """
        given = None if mask is None else self.mask(mask)
        rgb, known = decode_image(image, self._known)
        self._check_size("image", rgb)
        lens = self.calibration.lens
        frame = Frame(stamp_ns, rgb if lens is None else lens.undistort(rgb), self.calibration.camera, given)
        if stamp_ns > self._newest_ns:
            self._newest_ns = stamp_ns
            self._learn(known)
        return frame

    def mask(self, message: Any) -> UInt8 | None:
        """(H, W) uint8 of a given detection, as in ``Frame.given_mask``; None for an empty one.

        Raises:
            FrameError: it is malformed, or has another size than the calibration says.
        """
        mask = decode_mask(message)
        if mask is None:
            return None
        self._check_size("detection mask", mask)
        lens = self.calibration.lens
        return mask if lens is None else lens.undistort_mask(mask)

    def _check_size(self, what: str, pixels: UInt8) -> None:
        height, width = pixels.shape[:2]
        camera = self.calibration.camera
        if (width, height) != (camera.width, camera.height):
            raise FrameError(
                f"{what} is {width}x{height} px but camera_info is for {camera.width}x{camera.height} px: send the "
                f"calibration of the image as it is, or state binning and roi in camera_info"
            )

    def _learn(self, known: ValueRange) -> None:
        before, self._known = self._known, known
        if self._quiet:
            return
        if known.bits != before.bits:
            growth = f", not as {before.bits}-bit ones as up to now" if before.bits else ""
            LOG.info("16-bit images are read as %d-bit ones%s (option image_depth)", known.bits, growth)
        if known.full_luma != before.full_luma:
            LOG.info("YUV images are read with luma from 0 to 255, not from 16 to 235")
