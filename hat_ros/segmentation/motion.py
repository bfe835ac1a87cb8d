"""What moves against the background: a target differs from it in motion even where it does not in colour.

The background is taken to shift as a whole between two frames; its shift is the one that explains the image border
best. A pixel that no neighbour of its shifted place in earlier frames resembles belongs to something else; a textured
pixel that is exactly where the shift puts it belongs to the background.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from hat_ros.array_types import Bool, Float, Float32, UInt8
from hat_ros.segmentation.masks import Window

_MAX_LAG = 8  # frames
_MIN_LAG = 2
_BORDER_SHARE = 0.12  # width of the border that the shift must explain, of the shorter side
_MIN_STEP = 10  # 8-bit colour difference that counts
_MAX_SHARE = 0.5  # of the image: when more moves, the shift was wrong or the scene is no background
_STILL_SHARE = 0.3  # of the local contrast: a smaller change means that the texture did not move

_K3 = np.ones((3, 3), np.uint8)
_K5 = np.ones((5, 5), np.uint8)
_K7 = np.ones((7, 7), np.uint8)


@dataclass(frozen=True)
class MotionEvidence:
    """What motion says about the newest frame.

    Attributes:
        moving: (h, w) uint8 0/1, moved against the background.
        still: (h, w) uint8 0/1, texture that moved with the background.
    """

    moving: UInt8
    still: UInt8

    def found_share(self, mask: UInt8) -> float:
        """Share of what moves that a 0/1 mask contains, or has close by: what a target uncovers moves too."""
        around = np.asarray(cv2.dilate(mask, _K7), np.uint8)
        return np.count_nonzero(self.moving & around) / np.count_nonzero(self.moving)

    def still_share(self, mask: UInt8) -> float:
        """Share of a 0/1 mask, outline left out, that is background texture."""
        inside = np.asarray(cv2.erode(mask, _K5, borderType=cv2.BORDER_REPLICATE), np.uint8)
        return np.count_nonzero(self.still & inside) / max(1, int(np.count_nonzero(inside)))


class MotionDetector:
    """Remembers reduced frames and finds what moved against the background.

    Args:
        side_px: longer side of the image that is searched; larger frames are reduced on demand.
    """

    def __init__(self, side_px: int) -> None:
        self._side_px = side_px
        self._frames: deque[UInt8] = deque(maxlen=_MAX_LAG + 1)

    def push(self, rgb: UInt8) -> None:
        """Add the newest frame, (h, w, 3) uint8, reduced; a change of size starts afresh."""
        if self._frames and self._frames[-1].shape != rgb.shape:
            self._frames.clear()
        self._frames.append(rgb)

    def evidence(self) -> MotionEvidence | None:
        """What moved in the newest frame; None while too little is known or nothing stands out."""
        lag = len(self._frames) - 1
        if lag < _MIN_LAG or min(self._frames[-1].shape[:2]) < 24:
            return None
        now, before, long_before = (Window.whole(self._frames[-1 - k], self._side_px).rgb for k in (0, lag // 2, lag))
        far, far_change = _compare(now, long_before)
        near, _ = _compare(now, before)
        # Where the target was before differs too, but hardly in the same place at both lags.
        moving = np.asarray(cv2.medianBlur((np.minimum(far, near) > _MIN_STEP).astype(np.uint8), 3), np.uint8)
        size = 2 * max(1, round(0.02 * max(now.shape))) + 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        moving = np.asarray(
            cv2.morphologyEx(moving, cv2.MORPH_CLOSE, kernel, borderType=cv2.BORDER_REPLICATE), np.uint8
        )
        if not 8 <= np.count_nonzero(moving) <= _MAX_SHARE * moving.size:
            return None
        contrast = cv2.subtract(cv2.dilate(now, _K3), cv2.erode(now, _K3)).max(axis=2)
        still = (contrast > 2 * _MIN_STEP) & (far_change < _STILL_SHARE * contrast) & (moving == 0)
        return MotionEvidence(moving, still.astype(np.uint8))


def _compare(now: UInt8, before: UInt8) -> tuple[UInt8, UInt8]:
    """How the newest frame differs from an earlier one that follows the background.

    Returns:
        (h, w) uint8 colour distance of each pixel to the range of colours around its earlier place, which forgives
        half a pixel of shift, and its plain difference.
    """
    grey_now = cv2.cvtColor(now, cv2.COLOR_RGB2GRAY).astype(np.float32)
    grey_before = cv2.cvtColor(before, cv2.COLOR_RGB2GRAY).astype(np.float32)
    border = _border(grey_now.shape)
    everything = np.full(grey_now.shape, 255, np.uint8)
    size = now.shape[1::-1]
    best_cost = np.inf
    for shift in _shifts(grey_before, grey_now):
        moved = cv2.warpAffine(before, shift, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        seen = cv2.warpAffine(everything, shift, size, flags=cv2.INTER_LINEAR) == 255
        change = cv2.absdiff(now, moved).max(axis=2)
        cost = float(change[border & seen].mean())
        if cost < best_cost:
            best, best_change, best_seen, best_cost = moved, change, seen, cost
    above = cv2.subtract(now, cv2.dilate(best, _K3))
    below = cv2.subtract(cv2.erode(best, _K3), now)
    # What has come into view since has no past to compare with.
    return cv2.max(above, below).max(axis=2) * best_seen, np.where(best_seen, best_change, 255)


def _shifts(before: Float32, now: Float32) -> list[Float]:
    """Candidate shifts as 2x3 matrices: none, of the whole image, and of each of its halves."""
    h, w = now.shape
    parts = np.s_[:, :], np.s_[: h // 2], np.s_[h // 2 :], np.s_[:, : w // 2], np.s_[:, w // 2 :]
    out = [np.eye(2, 3)]
    for part in parts:
        a, b = np.ascontiguousarray(before[part]), np.ascontiguousarray(now[part])
        (dx, dy), _ = cv2.phaseCorrelate(a, b, cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F))
        if np.hypot(dx, dy) < 0.25 * max(h, w):
            out.append(np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]]))
    return out


def _border(shape: tuple[int, ...]) -> Bool:
    width = max(2, round(_BORDER_SHARE * min(shape)))
    border = np.ones(shape, bool)
    border[width:-width, width:-width] = False
    return border
