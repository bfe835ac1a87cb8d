"""Small operations on 0/1 masks, (H, W) uint8, and windows: parts of an image at reduced scale."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.target.masks import mask_moments

Mask = UInt8

SIDES = ("top", "bottom", "left", "right")


def touches_border(mask: Mask) -> bool:
    """Whether a mask reaches the image border."""
    return bool(touched_sides(mask))


def touched_sides(mask: Mask) -> tuple[str, ...]:
    """The sides of the image that a mask reaches."""
    touched = (mask[0].any(), mask[-1].any(), mask[:, 0].any(), mask[:, -1].any())
    return tuple(side for side, touches in zip(SIDES, touched, strict=True) if touches)


def border_contact(mask: Mask) -> float:
    """Share of a mask's outline that is the image border, 0 to 1."""
    at_border = sum(int(np.count_nonzero(side)) for side in (mask[0], mask[-1], mask[:, 0], mask[:, -1]))
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return at_border / max(1, sum(len(contour) for contour in contours))


def fill_holes(mask: Mask, max_share: float) -> Mask:
    """Fill enclosed holes smaller than a share of the mask's area: dark details, not gaps between parts."""
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    holes = [] if hierarchy is None else np.flatnonzero(hierarchy[0, :, 3] >= 0).tolist()
    if not holes:
        return mask
    out = mask.copy()
    limit = max_share * np.count_nonzero(mask)
    for i in holes:
        if cv2.contourArea(contours[i]) <= limit:
            cv2.drawContours(out, [contours[i]], -1, 1, -1)
    return out


def shrink(mask: Mask, side_px: int) -> Mask:
    """A mask reduced so that its longer side is at most ``side_px``, for comparing shapes."""
    scale = min(1.0, side_px / max(mask.shape))
    size = (max(1, round(mask.shape[1] * scale)), max(1, round(mask.shape[0] * scale)))
    return (cv2.resize(mask * 255, size, interpolation=cv2.INTER_AREA) > 127).astype(np.uint8)


def enlarge(mask: Mask, size: tuple[int, int]) -> Mask:
    """A reduced mask at a larger size (width, height)."""
    return (cv2.resize(mask * 255, size, interpolation=cv2.INTER_LINEAR) > 127).astype(np.uint8)


def moved(mask: Mask, dx: int, dy: int) -> Mask:
    """A mask moved by whole pixels, what leaves the image dropped."""
    if dx == dy == 0:
        return mask
    out = np.zeros_like(mask)
    h, w = mask.shape
    x0, x1, y0, y1 = max(0, dx), min(w, w + dx), max(0, dy), min(h, h + dy)
    if x1 > x0 and y1 > y0:
        out[y0:y1, x0:x1] = mask[y0 - dy : y1 - dy, x0 - dx : x1 - dx]
    return out


def shift_between(before: Mask | None, mask: Mask | None) -> tuple[int, int]:
    """Whole pixels (x, y) that a target moved; none while a mask is missing or cut by the image border."""
    if mask is None or before is None or touches_border(mask) or touches_border(before):
        return 0, 0
    dx, dy = np.rint(mask_moments(mask).center_px - mask_moments(before).center_px)
    return int(dx), int(dy)


def _reduced(rgb: UInt8, size: tuple[int, int]) -> UInt8:
    """A picture at a smaller size (width, height) by area; halving first is several times faster."""
    h, w = rgb.shape[:2]
    if min(w // size[0], h // size[1]) >= 4 and w % 2 == h % 2 == 0:
        rgb = np.asarray(cv2.resize(rgb, (w // 2, h // 2), interpolation=cv2.INTER_AREA), np.uint8)
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


@dataclass(frozen=True)
class Window:
    """A part of the image at reduced scale: full-resolution corner and size, reduced size, reduced colours."""

    x0: int
    y0: int
    width: int
    height: int
    scale: float
    rgb: UInt8

    @classmethod
    def whole(cls, rgb: UInt8, side_px: int, reduced: Window | None = None) -> Window:
        """The whole image, its longer side reduced to at most ``side_px``; faster from a larger such window."""
        h, w = rgb.shape[:2]
        scale = min(1.0, side_px / max(h, w))
        size = (max(1, round(w * scale)), max(1, round(h * scale)))
        source = rgb if reduced is None or reduced.scale < scale else reduced.rgb
        return cls(0, 0, w, h, scale, _reduced(source, size))

    @classmethod
    def around(cls, rgb: UInt8, box: tuple[int, int, int, int], margin: float, side_px: int) -> Window | None:
        """The image around a box (x0, y0, x1, y1), reduced likewise; None when hardly any of it is inside."""
        h, w = rgb.shape[:2]
        m = round(margin)
        x0, y0, x1, y1 = max(0, box[0] - m), max(0, box[1] - m), min(w, box[2] + m), min(h, box[3] + m)
        if x1 - x0 < 8 or y1 - y0 < 8:
            return None
        scale = min(1.0, side_px / max(x1 - x0, y1 - y0))
        size = (max(4, round((x1 - x0) * scale)), max(4, round((y1 - y0) * scale)))
        return cls(x0, y0, x1 - x0, y1 - y0, scale, _reduced(rgb[y0:y1, x0:x1], size))

    def reduce(self, mask: Mask, shift_xy: tuple[int, int] = (0, 0)) -> Mask:
        """This window of a full-resolution mask, moved by whole pixels, at reduced scale."""
        dx, dy = shift_xy
        h, w = mask.shape
        part = np.zeros((self.height, self.width), np.uint8)
        x0, y0 = max(self.x0, dx), max(self.y0, dy)
        x1, y1 = min(self.x0 + self.width, w + dx), min(self.y0 + self.height, h + dy)
        if x1 > x0 and y1 > y0:
            source = mask[y0 - dy : y1 - dy, x0 - dx : x1 - dx]
            part[y0 - self.y0 : y1 - self.y0, x0 - self.x0 : x1 - self.x0] = source * 255
        size = (self.rgb.shape[1], self.rgb.shape[0])
        return (cv2.resize(part, size, interpolation=cv2.INTER_AREA) > 127).astype(np.uint8)

    def enlarge(self, mask: Mask) -> Mask:
        """A reduced mask at full resolution, this window only."""
        return enlarge(mask, (self.width, self.height))
