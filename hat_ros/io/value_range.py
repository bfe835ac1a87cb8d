"""Which values black and white have where the encoding does not say: told, or found from the frames themselves.

Sensors of 10, 12 and 14 bits are sent in 16-bit images; the upper byte of such an image is almost black. Luma of YUV
goes from 16 to 235 (video) or from 0 to 255 (many USB cameras); taken for the other, dark parts are lost or the sky is
grey.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import UInt8

AUTO = "auto"
# What sensors have. Eight bits in a 16-bit image cannot be told from a dark picture: they are only ever told.
_FOUND_BITS = (10, 12, 14, 16)
# Luma of video leaves its range by noise alone, and not so far.
_FAR_BELOW, _FAR_ABOVE, _SHARE_OUTSIDE = 8, 243, 1e-3


@dataclass(frozen=True)
class ValueRange:
    """What is known so far; a value, replaced by another one when a frame tells more.

    A found depth is the smallest of 10, 12, 14 and 16 bits that holds every value seen so far. It grows and never
    shrinks, so a dark beginning is put right by the first bright frame, and the frames before a growth look brighter
    by the factor of the growth. Likewise luma is that of video until a frame has values far outside. Both depend on the
    past alone, so a replay finds the same.

    Attributes:
        bits: significant bits of 16-bit values; 0 = no such image has been seen yet.
        told: the user gave them; larger values saturate.
        full_luma: luma goes from 0 to 255.
    """

    bits: int = 0
    told: bool = False
    full_luma: bool = False

    @classmethod
    def of_option(cls, image_depth: str) -> ValueRange:
        """From the option ``camera.image_depth``: ``auto``, or a number of bits."""
        return cls() if image_depth == AUTO else cls(int(image_depth), told=True)

    def narrow(self, values: NDArray[np.uint16]) -> tuple[UInt8, ValueRange]:
        """The upper eight of the significant bits, and what is known after this image.

        Args:
            values: uint16 of any shape.
        """
        known = self if self.told else self._grown(int(values.max(initial=0)))
        shifted = values >> np.uint16(known.bits - 8)
        if known.told and known.bits < 16:
            shifted = np.minimum(shifted, np.uint16(255))
        return shifted.astype(np.uint8), known

    def with_luma(self, luma: UInt8) -> ValueRange:
        """What is known after an image of this luma."""
        if self.full_luma:
            return self
        outside = np.count_nonzero((luma < _FAR_BELOW) | (luma > _FAR_ABOVE))
        return replace(self, full_luma=bool(outside > _SHARE_OUTSIDE * luma.size))

    def _grown(self, largest: int) -> ValueRange:
        needed = next(bits for bits in _FOUND_BITS if largest < 1 << bits)
        return replace(self, bits=max(needed, self.bits))
