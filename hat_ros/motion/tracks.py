"""Point tracks: pyramidal Lucas-Kanade on the target's crop, checked backwards.

Tracks live in a fixed number of slots; a slot keeps its point until that is lost, then takes a new one. Points may lie
up to the edge of the silhouette: before a black background the corners of panels are the best there are.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from hat_ros.array_types import Bool, Float, Float32, Int, UInt8

_WINDOW_PX = 17
_LEVELS = 3
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.03)
_MIN_EIGENVALUE = 1e-4
# A track followed back must end this close to its start.
_BACKWARD_TOLERANCE_PX = 0.4
# Room around the points for the window at the coarsest pyramid level.
_CROP_PAD_PX = 32
# Weakest corner accepted, as a share of the strongest (Shi and Tomasi's smaller eigenvalue).
_CORNER_QUALITY = 0.004
# Points keep apart by this share of what an even spread over the region would give: the strongest corners of a scene
# crowd together, and a crowd tells little about depth.
_EVENNESS = 0.5
# New corners are looked for once this share of the slots is free, ...
_WORTHWHILE_SHARE = 0.1
# ... in every second frame, or when so much of what was followed is lost: a region that has fewer corners than there
# are slots does not have more of them in every frame.
_LOOK_PERIOD = 2
_LOST_SHARE = 0.25


class PointTracks:
    """Tracks of at most ``n_slots`` points.

    Args:
        n_slots: number of slots N.
        spacing_px: least distance between a new point and any other; more where the region is large.

    Attributes:
        xy: (N, 2) pixel positions in the newest image.
        alive: (N,) which slots hold a point.
        track_id: (N,) identity of each slot's point; a number is never used again.
    """

    def __init__(self, n_slots: int, spacing_px: float) -> None:
        self._spacing_px = spacing_px
        self.xy = np.zeros((n_slots, 2))
        self.alive = np.zeros(n_slots, dtype=bool)
        self.track_id = np.full(n_slots, -1)
        self._next_id = 0
        self._n_followed = 0  # after the last look for corners
        self._since_look = 0
        self._image: UInt8 | None = None

    def advance(self, image: UInt8, region: UInt8, xy_guess: Float) -> None:
        """Follow all points into the next image; those that are lost or leave the region free their slots.

        Args:
            image: (H, W) uint8, background black.
            region: (H, W) uint8, nonzero where points may lie.
            xy_guess: (N, 2) expected positions.
        """
        slots = np.flatnonzero(self.alive)
        before = image if self._image is None else self._image
        xy, found = follow(before, image, self.xy[slots], xy_guess[slots])
        size = np.array([image.shape[1], image.shape[0]]) - 1
        col, row = np.clip(np.rint(xy).astype(int), 0, size).T
        found &= region[row, col] > 0
        self.xy[slots] = xy
        self.alive[slots[~found]] = False
        self._image = image

    def replenish(self, image: UInt8, region: UInt8) -> Int:
        """Fill free slots with new corners; returns the slots filled."""
        self._image = image
        free = np.flatnonzero(~self.alive)
        self._since_look += 1
        n_alive = len(self.alive) - len(free)
        lost = n_alive <= (1.0 - _LOST_SHARE) * self._n_followed
        if len(free) < _WORTHWHILE_SHARE * len(self.alive) or not (lost or self._since_look >= _LOOK_PERIOD):
            return free[:0]
        even_px = np.sqrt(np.count_nonzero(region) / len(self.alive))
        spacing_px = max(self._spacing_px, _EVENNESS * float(even_px))
        corners = detect(image, region, self.xy[self.alive], len(free), spacing_px)
        slots = free[: len(corners)]
        self.xy[slots] = corners
        self.alive[slots] = True
        self.track_id[slots] = self._next_id + np.arange(len(slots))
        self._next_id += len(slots)
        self._n_followed, self._since_look = n_alive + len(slots), 0
        return slots


def follow(previous: UInt8, current: UInt8, xy: Float, xy_guess: Float) -> tuple[Float, Bool]:
    """Positions of points in the next image.

    Args:
        previous, current: (H, W) uint8 images.
        xy: (M, 2) pixel positions in ``previous``; xy_guess: (M, 2) expected ones in ``current``.

    Returns:
        (M, 2) positions, and (M,) whether they were found and lead back to where they came from.
    """
    if not len(xy):
        return xy.copy(), np.zeros(0, dtype=bool)
    xy_guess = np.clip(xy_guess, 0, np.array([previous.shape[1], previous.shape[0]]) - 1)
    x0, y0, x1, y1 = _crop(previous.shape, np.concatenate([xy, xy_guess]))
    before = np.ascontiguousarray(previous[y0:y1, x0:x1])
    after = np.ascontiguousarray(current[y0:y1, x0:x1])
    origin = np.array([x0, y0], dtype=np.float64)
    start, guess = (xy - origin).astype(np.float32), (xy_guess - origin).astype(np.float32)
    moved, ok = _lucas_kanade(before, after, start, guess, _LEVELS)
    back, ok_back = _lucas_kanade(after, before, moved, start.copy(), 0)
    found = ok & ok_back & (np.linalg.norm(back - start, axis=1) < _BACKWARD_TOLERANCE_PX)
    size = np.array([x1 - x0, y1 - y0])
    found &= ((moved >= 0) & (moved <= size - 1)).all(axis=1)
    return moved.astype(np.float64) + origin, found


def _lucas_kanade(before: UInt8, after: UInt8, start: Float32, guess: Float32, levels: int) -> tuple[Float32, Bool]:
    """(M, 2) points of one image followed into another from guesses (M, 2), which are overwritten; (M,) found."""
    moved, ok, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        start,
        guess,
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=levels,
        criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_MIN_EIGENVALUE,
    )
    return np.asarray(moved, np.float32), ok.ravel() > 0


def detect(image: UInt8, region: UInt8, taken: Float, count: int, spacing_px: float) -> Float:
    """Strongest corners of a region, clear of points already taken.

    Args:
        image: (H, W) uint8.
        region: (H, W) uint8, nonzero where points may lie.
        taken: (M, 2) pixel positions to keep ``spacing_px`` away from.
        count: how many at most.
        spacing_px: smallest distance between points.

    Returns:
        (n, 2) pixel positions, strongest first.
    """
    x, y, width, height = cv2.boundingRect(region)
    if min(width, height) < _WINDOW_PX // 2 or count <= 0:
        return np.zeros((0, 2))
    free = region[y : y + height, x : x + width].copy()
    radius = max(1, round(spacing_px))
    disk = np.zeros((2 * radius + 1, 2 * radius + 1), np.uint8)
    cv2.circle(disk, (radius, radius), radius, 1, -1)
    clear_disks(free, np.rint(taken).astype(np.int64) - np.array([x, y], np.int64), disk)
    crop = np.ascontiguousarray(image[y : y + height, x : x + width])
    corners = cv2.goodFeaturesToTrack(crop, count, _CORNER_QUALITY, spacing_px, mask=free, blockSize=5)
    if corners is None:
        return np.zeros((0, 2))
    return corners.reshape(-1, 2).astype(np.float64) + np.array([x, y])


@njit(cache=True)
def clear_disks(mask: UInt8, centers: Int, disk: UInt8) -> None:
    """Set a mask (H, W) to zero where disk (2 r + 1, 2 r + 1) is not, laid on each of the centers (M, 2) x, y.

    Keeps the interpreter lock: one call per point of OpenCV would hand it over as often.
    """
    radius = disk.shape[0] // 2
    for i in range(len(centers)):
        x0, y0 = centers[i, 0] - radius, centers[i, 1] - radius
        for y in range(max(0, -y0), min(disk.shape[0], mask.shape[0] - y0)):
            for x in range(max(0, -x0), min(disk.shape[1], mask.shape[1] - x0)):
                if disk[y, x]:
                    mask[y0 + y, x0 + x] = 0


def _crop(shape: tuple[int, ...], xy: Float) -> tuple[int, int, int, int]:
    """Half-open pixel box x0, y0, x1, y1 around points, padded and clipped to the image."""
    height, width = shape[:2]
    x0, y0 = np.floor(xy.min(axis=0)).astype(int) - _CROP_PAD_PX
    x1, y1 = np.ceil(xy.max(axis=0)).astype(int) + _CROP_PAD_PX + 1
    return max(int(x0), 0), max(int(y0), 0), min(int(x1), width), min(int(y1), height)
