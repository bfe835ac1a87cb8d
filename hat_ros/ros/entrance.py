"""What waits before the graph: images, their masks and the calibration, until the next frame may be admitted."""

from __future__ import annotations

from collections import deque
from typing import Any

from hat_ros.core.refusals import Refusals
from hat_ros.core.sync import Admission
from hat_ros.errors import FrameError
from hat_ros.io import messages
from hat_ros.io.calibration import Calibration
from hat_ros.io.frame_decoder import FrameDecoder
from hat_ros.types import Frame

_MASKS_KEPT = 64


class Entrance:
    """Puts frames together and refuses those that may not enter.

    Args:
        live: keep only the newest image and count those that it replaces; otherwise all wait their turn.
        with_masks: a frame is complete only with its mask message (an empty one says "no detection").
        image_depth: option ``camera.image_depth``.

    Attributes:
        dropped_total: images that were replaced, lost by the middleware, or refused.
        refusals: those that were refused.
    """

    def __init__(self, live: bool, with_masks: bool, image_depth: str = "auto") -> None:
        self._live = live
        self._images: deque[tuple[int, Any]] = deque()
        self._with_masks = with_masks
        self._masks: dict[int, Any] = {}
        self._last_number: dict[str, int] = {}
        self._image_depth = image_depth
        self._decoder: FrameDecoder | None = None
        self._count_gaps = True
        self.dropped_total = 0
        self.refusals = Refusals()

    def __len__(self) -> int:
        """Images that wait."""
        return len(self._images)

    @property
    def is_calibrated(self) -> bool:
        """There is a calibration."""
        return self._decoder is not None

    def add_image(self, topic: str, message: Any, number: int | None) -> None:
        """Queue an image.

        Args:
            topic: where it came from.
            message: Image or CompressedImage.
            number: the publisher's sequence number if the middleware tells it. With a queue of one, DDS overwrites an
                image that was not taken yet; only the gap in the numbers shows it.
        """
        if number is not None and self._count_gaps:
            self.dropped_total += max(0, number - self._last_number.get(topic, number - 1) - 1)
            self._last_number[topic] = number
        if self._live and self._images:
            self._images.clear()
            self.dropped_total += 1
        self._images.append((messages.stamp_of(message), message))

    def forget_numbers(self) -> None:
        """Gaps in the publisher's numbers mean nothing any more: there are several publishers."""
        self._count_gaps = False

    def add_mask(self, message: Any) -> None:
        """Keep a mask for its image; of many the one that came first goes, since stamps may begin anew."""
        stamp_ns = messages.stamp_of(message)
        self._masks.pop(stamp_ns, None)
        self._masks[stamp_ns] = message
        if len(self._masks) > _MASKS_KEPT:
            del self._masks[next(iter(self._masks))]

    def set_calibration(self, calibration: Calibration) -> bool:
        """Take over a calibration; whether it replaces a different one. One that agrees changes nothing.

        Raises:
            FrameError: it does, in a replay: a run has one calibration.
        """
        if self._decoder is not None and self._decoder.calibration.is_same(calibration):
            return False
        replaces = self._decoder is not None
        if replaces and not self._live:
            raise FrameError("camera_info changes during the run: split the recording, or start a new run")
        self._decoder = FrameDecoder(calibration, self._image_depth)
        return replaces

    def next_frame(self, admission: Admission) -> tuple[Frame, str] | None:
        """The next frame that may enter, and its ``frame_id``; None while there is none that is complete.

        Raises:
            FrameError: the next image may not enter: its stamp, encoding or size. It is gone and counted.
        """
        if not self._images or self._decoder is None:
            return None
        stamp_ns, message = self._images[0]
        try:
            admission.check(stamp_ns)
            if self._with_masks and stamp_ns not in self._masks:
                return None
            mask = self._masks.pop(stamp_ns) if self._with_masks else None
            frame = self._decoder.frame(stamp_ns, message, mask)
        except FrameError as error:
            self._images.popleft()
            self.dropped_total += 1
            self.refusals.add(f"frame {stamp_ns}: {error}")
            raise FrameError(f"frame {stamp_ns} refused: {error}") from None
        self._images.popleft()
        return frame, message.header.frame_id
