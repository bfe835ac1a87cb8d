"""A target before a textured, moving background: colour models of both sides and a graph cut between them.

The cut is GrabCut (Rother, Kolmogorov, Blake, ACM Trans. Graphics 23, 2004) on a strongly reduced image, seeded by
what is known; :mod:`hat_ros.segmentation.boundary` then finds the outline at full resolution.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from hat_ros.array_types import Float, Float32, UInt8
from hat_ros.segmentation.ground import GroundEvidence
from hat_ros.segmentation.masks import SIDES, Mask, fill_holes

_COLD_ITERATIONS = 3
_RING_SHARE = 0.02  # width of the image border taken as background, of the longer side
_PIECE_SHARE = 0.03  # pieces smaller than this share of the largest are not the target's
_MOTION_REACH = 0.6  # of the size of what moved: how far beyond it the target may extend
_CLOSED_SHORT = 0.5  # of its length: how far before the border a closed cut of what that cuts off may end
_OPEN_BESIDE = 0.25  # of what is known of the target: how far beyond its extent a side opens

_NO_BOX = (0, 0, 0, 0)  # GrabCut starts from labels instead
_K3 = np.ones((3, 3), np.uint8)


@dataclass
class ColorModels:
    """Mixtures of five Gaussians in RGB for both sides, in GrabCut's own layout; adapted by every cut."""

    background: Float = field(default_factory=lambda: np.zeros((1, 65)))
    foreground: Float = field(default_factory=lambda: np.zeros((1, 65)))

    def copy(self) -> ColorModels:
        """The same models, free to adapt differently."""
        return ColorModels(self.background.copy(), self.foreground.copy())

    def adopt(self, other: ColorModels) -> None:
        """Become like other models."""
        self.background[:], self.foreground[:] = other.background, other.foreground

    @property
    def learned(self) -> bool:
        """Whether a cut has filled them."""
        return bool(self.background.any() and self.foreground.any())


@dataclass(frozen=True)
class ClearCut:
    """A reduced (h, w) 0/1 mask with the colour step across its outline (see :func:`edge_contrast`).

    ``confirmed`` by the ground behind it, or not.
    """

    mask: Mask
    contrast: float
    confirmed: bool = False


def graph_cut(rgb: UInt8, labels: Mask, models: ColorModels, iterations: int) -> Mask | None:
    """(h, w) 0/1 mask from GrabCut labels (cv2.GC_*), None when one side is empty; the models adapt to it."""
    foreground = int(np.count_nonzero(labels & 1))
    if foreground < 8 or labels.size - foreground < 8:
        return None
    labels = labels.copy()
    mode = cv2.GC_EVAL if models.learned else cv2.GC_INIT_WITH_MASK
    cv2.setRNGSeed(0)  # its k-means draws from OpenCV's global generator
    cv2.grabCut(rgb, labels, _NO_BOX, models.background, models.foreground, iterations, mode)
    return labels & np.uint8(1)


def cut_from_seeds(
    rgb: UInt8,
    seeds: list[Mask],
    margin_px: float,
    models: ColorModels,
    seen: GroundEvidence | None = None,
) -> Mask | None:
    """Cut where seeds (0/1 masks of the same target) leave doubt.

    What all seeds contain, ``margin_px`` from their outlines, is target; what is that far outside all of them is
    background; the rest is decided by the image, starting from the first seed. What is seen to stand before the ground
    is target as far as it hangs together with the seeds; what is like the ground is none outside the seeds, and not
    certainly in them.
    """
    size = 2 * max(1, round(margin_px)) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    every = np.minimum.reduce(seeds)
    some = np.maximum.reduce(seeds)
    sure = cv2.erode(every, kernel, borderType=cv2.BORDER_REPLICATE)
    maybe = np.asarray(cv2.dilate(some, kernel), np.uint8)
    labels = np.where(maybe > 0, np.where(seeds[0] > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD), cv2.GC_BGD)
    labels = np.where(sure > 0, cv2.GC_FGD, labels).astype(np.uint8)
    if seen is not None:
        every |= _note_ground(labels, seen, some, maybe)
    cut = graph_cut(rgb, labels, models, 1)
    return None if cut is None else tidy(cut, every)


def _note_ground(labels: Mask, seen: GroundEvidence, some: Mask, near: Mask) -> Mask:
    """Write what is known of the ground into GrabCut labels; the pieces before it that reach ``near``, 0/1.

    Like the ground means as dark as the sea as well, so ``some`` seed may know better.
    """
    count, pieces = cv2.connectedComponents(seen.target, connectivity=8)
    touched = np.bincount(pieces[(near & seen.target) > 0], minlength=count) > 0
    target = touched[pieces].astype(np.uint8) & seen.target
    labels[(seen.ground > 0) & (labels == cv2.GC_FGD)] = cv2.GC_PR_FGD
    labels[(seen.ground > 0) & (some == 0)] = cv2.GC_BGD
    labels[target > 0] = cv2.GC_PR_FGD
    labels[cv2.erode(target, _K3, borderType=cv2.BORDER_REPLICATE) > 0] = cv2.GC_FGD
    return target


def cut_from_nothing(
    rgb: UInt8,
    open_side: str | None = None,
    near: Mask | None = None,
    iterations: int = _COLD_ITERATIONS,
) -> Mask | None:
    """Cut with the image border as the only example of background.

    Args:
        rgb: (h, w, 3) reduced image.
        open_side: top, bottom, left or right: there the target may reach the border.
        near: 0/1 mask of what is known of the target; the side opens only beside it.
        iterations: of GrabCut; the first takes as long as the other two.
    """
    labels = np.full(rgb.shape[:2], cv2.GC_PR_FGD, np.uint8)
    ring = _ring_px(rgb)
    labels[:ring] = labels[-ring:] = cv2.GC_BGD
    labels[:, :ring] = labels[:, -ring:] = cv2.GC_BGD
    if open_side is not None:
        rows, cols = slice(None), slice(None)
        if near is not None:
            x, y, w, h = cv2.boundingRect(near)
            rows = slice(max(0, y - round(_OPEN_BESIDE * h)), y + h + round(_OPEN_BESIDE * h))
            cols = slice(max(0, x - round(_OPEN_BESIDE * w)), x + w + round(_OPEN_BESIDE * w))
        depth = 3 * ring
        part = {
            "top": np.s_[:depth, cols],
            "bottom": np.s_[-depth:, cols],
            "left": np.s_[rows, :depth],
            "right": np.s_[rows, -depth:],
        }[open_side]
        labels[part] = cv2.GC_PR_FGD
    cut = graph_cut(rgb, labels, ColorModels(), iterations)
    return None if cut is None else tidy(cut, None)


def near_sides(closed: Mask) -> tuple[str, ...]:
    """Sides of the image at which more of a target may be than a closed cut from nothing holds, 0/1.

    Its part at the border gives its colours to the background, so that the cut may end some way before it.
    """
    x, y, w, h = cv2.boundingRect(closed)
    reach = _ring_px(closed) + _CLOSED_SHORT * max(w, h)
    height, width = closed.shape
    gaps = (y, height - y - h, x, width - x - w)
    return tuple(side for side, gap in zip(SIDES, gaps, strict=True) if gap <= reach)


def _ring_px(image: UInt8) -> int:
    return max(2, round(_RING_SHARE * max(image.shape[:2])))


def cut_from_motion(rgb: UInt8, moving: Mask, iterations: int = _COLD_ITERATIONS) -> Mask | None:
    """Cut around what moved, (h, w) 0/1: parts of the target, rarely all of it, and nothing far from it.

    ``iterations`` as for :func:`cut_from_nothing`.
    """
    points = cv2.findNonZero(moving)
    hull = cv2.fillConvexPoly(np.zeros_like(moving), cv2.convexHull(points), 1)
    x, y, w, h = cv2.boundingRect(points)
    reach = round(_MOTION_REACH * max(w, h)) + 2
    labels = np.full(moving.shape, cv2.GC_BGD, np.uint8)
    labels[max(0, y - reach) : y + h + reach, max(0, x - reach) : x + w + reach] = cv2.GC_PR_BGD
    labels[hull > 0] = cv2.GC_PR_FGD
    cut = graph_cut(rgb, labels, ColorModels(), iterations)
    return None if cut is None else tidy(cut, moving)


def tidy(mask: Mask, anchor: Mask | None) -> Mask | None:
    """The largest piece (or those that touch the anchor) without holes; None when nothing is left."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    if count < 2:
        return None
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    keep = area == area.max()
    if anchor is not None:
        touched = np.bincount(label[anchor > 0], minlength=count)
        keep |= (touched > 0) & (area >= _PIECE_SHARE * area.max())
    keep[0] = False
    return fill_holes(keep.astype(np.uint8)[label], 0.05)


def edge_contrast(step: Float32, mask: Mask) -> float:
    """How clearly a mask's outline shows: lower quartile of the colour steps (h, w) along it; 0 without an outline."""
    outer = cv2.dilate(mask, np.ones((3, 3), np.uint8))
    inner = cv2.erode(mask, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    outline = outer != inner
    outline[0] = outline[-1] = False
    outline[:, 0] = outline[:, -1] = False
    steps = step[outline]
    return float(np.partition(steps, len(steps) // 4)[len(steps) // 4]) if len(steps) >= 8 else 0.0


def chance_contrast(step: Float32, mask: Mask) -> float:
    """Median of the colour steps (h, w) in the background, where an outline drawn by chance would lie."""
    away = cv2.dilate(mask, np.ones((7, 7), np.uint8)) == 0
    return float(np.median(step[away])) if away.any() else 0.0


def color_step(rgb: UInt8) -> Float32:
    """Colour step (8-bit, across two pixels) at each pixel of an (h, w, 3) image."""
    dx = cv2.Sobel(rgb, cv2.CV_32F, 1, 0, ksize=3, scale=0.25)
    dy = cv2.Sobel(rgb, cv2.CV_32F, 0, 1, ksize=3, scale=0.25)
    return np.asarray(cv2.sqrt(cv2.transform(dx * dx + dy * dy, np.ones((1, 3)))), np.float32)
