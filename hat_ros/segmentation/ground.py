"""The ground behind the target, remembered: most of what a target hides now was seen before it got in the way.

The ground shifts through the image as a whole, by a homography from frame to frame, found from point tracks outside
the target. Earlier frames carried along by it say what each pixel would look like without the target. Where all of
them disagree with the image stands something else; where the image is what they say, from so far back that the target
was elsewhere, there is ground. Neither owes anything to the colours of the target, so that a part that turns into view
is found although its colour has never been seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from hat_ros.array_types import Float, UInt8
from hat_ros.segmentation.masks import Mask, Window
from hat_ros.target.masks import overlap

_SIDE_PX = 320  # longer side of the frames remembered
_MAX_POINTS = 80
_FEW_POINTS = 0.5  # share of those chosen that is followed on; with fewer, all are chosen anew
_MIN_POINTS = 12
_POINT_QUALITY = 0.005
_POINT_SPACING_PX = 10
_TRACK_PX = 15  # side of the patches tracked
_MAX_ERROR_PX = 0.7  # of a track that follows the ground
_MIN_FOLLOWING = 0.5  # share of tracks that must
_SPACING_PX = 5.0  # shift of the ground between frames remembered, at their scale
_MAX_FRAMES = 40
_LAGS = (0.2, 0.5, 1.0, 1.5)  # shifts of the ground behind the frames compared, of the target's length
_MIN_SHIFT_PX = 6.0  # least shift that tells anything, in the image
_MAX_SHIFT = 0.6  # of a window: what was beyond is hardly in view any more
_STEP = 10  # 8-bit colour difference that counts
_SAME = 4  # and one that does not
_ALL_AROUND = 0.85  # share of a mask and its surroundings where the ground is known, for it to be beyond doubt
_CONFIRMED = 0.85  # overlap with what is unlike the ground
_SHOWN = 0.3  # share of a mask that is unlike the ground
_CONTRADICTED = 0.5  # share that is ground
CLEAR = 0.9  # from so many lengths back none of the target is where it is now

_NO_POINTS = np.zeros((0, 2), np.float32)
_NO_MOTION = np.zeros((0, 3, 3))
_STANDSTILL = np.eye(3)[None]
_K3 = np.ones((3, 3), np.uint8)
_K5 = np.ones((5, 5), np.uint8)


@dataclass(frozen=True)
class GroundEvidence:
    """What earlier frames say about a window of the newest.

    Attributes:
        target: (h, w) uint8 0/1, unlike the ground.
        ground: (h, w) uint8 0/1, like the ground, from so far back that the target was elsewhere.
        known: (h, w) uint8 0/1, where the ground has been seen.
    """

    target: Mask
    ground: Mask
    known: Mask

    def confirms(self, mask: Mask) -> bool:
        """Whether a 0/1 mask is what stands before the ground, all around which that is known."""
        around = np.asarray(cv2.dilate(mask, _K5), np.uint8)
        if np.count_nonzero(around & self.known) < _ALL_AROUND * np.count_nonzero(around):
            return False
        return overlap(mask & self.known, self.target) >= _CONFIRMED

    def shows(self, mask: Mask) -> bool:
        """Whether much of a 0/1 mask is seen to stand before the ground."""
        return bool(np.count_nonzero(mask & self.target) >= _SHOWN * np.count_nonzero(mask))

    def contradicts(self, mask: Mask) -> bool:
        """Whether most of a 0/1 mask is ground."""
        return bool(np.count_nonzero(mask & self.ground) > _CONTRADICTED * np.count_nonzero(mask))


@dataclass
class _Remembered:
    """A frame at reduced scale, and where the target was not (0/1)."""

    rgb: UInt8
    free: Mask


class GroundMemory:
    """Remembers reduced frames and how the ground has moved since."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget earlier frames."""
        self._frames: list[_Remembered] = []
        self._H_now_then = _NO_MOTION  # homographies of the frames to the newest
        self._points = _NO_POINTS
        self._n_chosen = 0  # points to start with
        self._grey: UInt8 | None = None
        self._scale = (1.0, 1.0)

    def push(self, rgb: UInt8, mask_before: Mask | None) -> Window:
        """Add the newest frame, (H, W, 3) uint8, and say where the target was in the one before, if that is known.

        Returns:
            The frame as it is remembered.
        """
        whole = Window.whole(rgb, _SIDE_PX)
        small = whole.rgb
        grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), np.uint8)
        if self._grey is not None and self._grey.shape == grey.shape:
            if mask_before is not None:
                size = (small.shape[1], small.shape[0])
                covered = cv2.resize(mask_before * 255, size, interpolation=cv2.INTER_AREA) > 0
                self._frames[-1].free = np.asarray(1 - cv2.dilate(covered.astype(np.uint8), _K5), np.uint8)
            else:
                self._points = _NO_POINTS  # they may have been the target's
            self._carry(self._follow(self._grey, grey), grey.shape)
        else:
            self._frames, self._H_now_then, self._points = [], _NO_MOTION, _NO_POINTS
        self._frames.append(_Remembered(small, np.ones(grey.shape, np.uint8)))
        self._H_now_then = np.concatenate([self._H_now_then, _STANDSTILL])
        self._grey = grey
        self._scale = (small.shape[1] / rgb.shape[1], small.shape[0] / rgb.shape[0])
        return whole

    def _follow(self, before: UInt8, grey: UInt8) -> Float | None:
        """(3, 3) homography that most point tracks follow into the next frame outside the target; None without one."""
        free, points = self._frames[-1].free, self._points
        if len(points):
            x, y = np.rint(points).astype(int).T
            inside = (x >= 0) & (y >= 0) & (x < free.shape[1]) & (y < free.shape[0])
            points = points[inside]
            points = points[free[y[inside], x[inside]] > 0]
        if len(points) <= max(_MIN_POINTS, _FEW_POINTS * self._n_chosen):
            corners = cv2.goodFeaturesToTrack(before, _MAX_POINTS, _POINT_QUALITY, _POINT_SPACING_PX, mask=free)
            points = _NO_POINTS if corners is None else np.asarray(corners, np.float32).reshape(-1, 2)
            self._n_chosen = len(points)
        self._points = _NO_POINTS
        if len(points) < _MIN_POINTS:
            return None
        patch = (_TRACK_PX, _TRACK_PX)
        guess = points.copy()  # not used, but the signature wants one
        ahead, found, _ = cv2.calcOpticalFlowPyrLK(before, grey, points, guess, winSize=patch, maxLevel=2)
        tracked = np.asarray(ahead, np.float32)
        good = found.ravel() == 1
        if np.count_nonzero(good) < _MIN_POINTS:
            return None
        H, follows = cv2.findHomography(points[good], tracked[good], cv2.RANSAC, _MAX_ERROR_PX)
        if H is None or follows.mean() < _MIN_FOLLOWING:
            return None
        self._points = tracked[good][follows.ravel() == 1]
        return np.asarray(H, np.float64)

    def _carry(self, H_next_prev: Float | None, shape: tuple[int, ...]) -> None:
        """Take the next frame's view; forget what is too close to its neighbour, or all where the ground was lost."""
        if H_next_prev is None:
            self._frames, self._H_now_then = [], _NO_MOTION
            return
        H = H_next_prev @ self._H_now_then
        height, width = shape
        if len(H) >= 2:
            (x0, y0), (x1, y1) = _carried(H[-2:], (width / 2, height / 2))
            if math.hypot(x1 - x0, y1 - y0) < _SPACING_PX:
                H = H[:-1]
                del self._frames[-1]
        del self._frames[:-_MAX_FRAMES]
        self._H_now_then = H[-_MAX_FRAMES:]

    def evidence(self, window: Window, length_px: float) -> GroundEvidence | None:
        """Compare a window of the newest frame with the ground; None while too little of it is known.

        Args:
            window: of the newest frame as pushed.
            length_px: of the target, in full-resolution pixels.
        """
        to_window = self._to_window(window)
        compared = self._compared(window, length_px)
        if not compared:
            return None
        changes = [_compare(window.rgb, self._frames[i], to_window @ self._H_now_then[i]) for i, _ in compared]
        least, known = _least(changes)
        ground = np.zeros_like(known)
        clear = [
            change for change, (_, shift_px) in zip(changes, compared, strict=True) if shift_px >= CLEAR * length_px
        ]
        if clear:
            # From so far back nothing of the target is compared with itself: this counts where it is known.
            far_least, far_known = _least(clear)
            least, known = np.where(far_known > 0, far_least, least), known | far_known
            ground = ((far_least <= _SAME) & (far_known > 0)).astype(np.uint8)
        target = np.asarray(cv2.medianBlur(((least > _STEP) & (known > 0)).astype(np.uint8), 3), np.uint8)
        return GroundEvidence(target, ground & (1 - target), known)

    def length_known_px(self, window: Window) -> float:
        """Length of the longest target, in full-resolution pixels, that evidence in a window can show completely."""
        shifts_px = self._shifts_px(window)
        usable = shifts_px[shifts_px <= _MAX_SHIFT * max(window.width, window.height)]
        return float(usable.max(initial=0.0)) / _LAGS[-1]

    def _shifts_px(self, window: Window) -> Float:
        """(n,) how far the ground in the middle of a window has moved since each past frame, full resolution."""
        sx, sy = self._scale
        middle = ((window.x0 + window.width / 2) * sx, (window.y0 + window.height / 2) * sy)
        dx, dy = (_carried(self._H_now_then[:-1], middle) - middle).T
        return np.sqrt(dx * dx + dy * dy) / sx

    def _to_window(self, window: Window) -> Float:
        """(3, 3) from the remembered scale to a window's, pixel centres at integers."""
        (sx, sy), (h, w) = self._scale, window.rgb.shape[:2]
        u, v = w / window.width, h / window.height
        return np.array(
            [
                [u / sx, 0, (0.5 / sx - window.x0) * u - 0.5],
                [0, v / sy, (0.5 / sy - window.y0) * v - 0.5],
                [0, 0, 1.0],
            ]
        )

    def _compared(self, window: Window, length_px: float) -> list[tuple[int, float]]:
        """Numbers of the frames worth a comparison, with the shift of the ground since, full-resolution pixels."""
        shifts_px = self._shifts_px(window)
        chosen: dict[int, float] = {}
        for lag in _LAGS:
            far = np.flatnonzero(shifts_px >= max(lag * length_px, _MIN_SHIFT_PX))
            if len(far):
                chosen[int(far[-1])] = float(shifts_px[far[-1]])
        return list(chosen.items())


def _carried(H_now_then: Float, at: tuple[float, float]) -> Float:
    """(n, 2) where the ground that was at a point in each frame is now: by (n, 3, 3) homographies."""
    now = H_now_then @ np.array([*at, 1.0])
    return now[:, :2] / now[:, 2:]


def _least(changes: list[tuple[UInt8, Mask]]) -> tuple[UInt8, Mask]:
    """The least of several changes (h, w), and where enough frames have seen the ground to say so, 0/1.

    Where the target was before differs too, but not in the same place in two frames.
    """
    least = np.full(changes[0][0].shape, 255, np.uint8)
    count = np.zeros_like(least)
    for change, seen in changes:
        least = np.minimum(least, np.maximum(change, 255 * (1 - seen)))
        count += seen
    return least, (count >= min(2, len(changes))).astype(np.uint8)


def _compare(now: UInt8, then: _Remembered, H: Float) -> tuple[UInt8, UInt8]:
    """Colour distance (h, w) of each pixel to the range of ground colours around its earlier place, which forgives
    half a pixel of shift, and where the ground was seen, 0/1."""
    size = now.shape[1::-1]
    ground = cv2.warpPerspective(then.rgb, H, size, flags=cv2.INTER_LINEAR)
    seen = cv2.warpPerspective(then.free, H, size, flags=cv2.INTER_NEAREST)
    above = cv2.subtract(now, cv2.dilate(ground, _K3))
    below = cv2.subtract(cv2.erode(ground, _K3), now)
    red, green, blue = cv2.split(cv2.max(above, below))
    clear = cv2.erode(seen, _K3, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(cv2.max(cv2.max(red, green), blue), np.uint8), np.asarray(clear, np.uint8)
