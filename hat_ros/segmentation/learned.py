"""Segmentation by a small network that ships with the package: ``segmentation.backend: learned``.

The network never saw the target: it knows what spacecraft look like before sky, planets and clutter
(:mod:`hat_ros.segmentation.network`). A tracked target is looked at in a window around where it is expected, with the
predicted silhouette, or else the previous mask, as prior. Without either, the whole image is searched, and what is
found there is looked at again in windows of its own. A mask is kept only if the evidence of the image alone, which was
not told the prior, is for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hat_ros.array_types import Float32, UInt8
from hat_ros.config import HatConfig
from hat_ros.segmentation.boundary import refine_outline
from hat_ros.segmentation.masks import Mask, moved, shift_between
from hat_ros.segmentation.network import PRIOR_STRIDE, STRIDE, SegmentationNetwork
from hat_ros.segmentation.shape import SilhouetteBank
from hat_ros.target.model import Target
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.types import Detection, Frame, PosePrior

Box = tuple[int, int, int, int]

# Longer side of a window, and of a whole image that is searched: what the network was trained on. Pixels.
_WINDOW_PX = 6 * STRIDE
_SEARCH_PX = 12 * STRIDE
# A target fills so much of its window; in training between 0.4 and 0.85.
_FILL = 0.65
# A small target is enlarged this much at most: finer pixels than that hold nothing new.
_MAX_ENLARGEMENT = 2.0
# The outline of a mask is sharpened within so many window pixels, where the colours of its sides differ by this much
# (8-bit).
_BAND_CELLS, _MIN_CONTRAST = 1.5, 10.0
# Regions of a searched image that are looked at again.
_MAX_REGIONS = 3


@dataclass(frozen=True, eq=False)
class Window:
    """A part of the image at the network's scale; what lies beyond the image is black.

    Attributes:
        x0: left column, may be negative.
        y0: top row.
        scale: window pixels per image pixel.
        rgb: (h, w, 3) uint8, h and w multiples of STRIDE.
    """

    x0: float
    y0: float
    scale: float
    rgb: UInt8

    @classmethod
    def around(cls, rgb: UInt8, box: Box, side_px: int, fill: float = 1.0) -> Window:
        """The window in whose middle a box (x0, y0, x1, y1) fills a share of the longer side."""
        width, height = box[2] - box[0], box[3] - box[1]
        scale = min(fill * side_px / max(width, height, 1), _MAX_ENLARGEMENT)
        sides = [int(STRIDE * np.ceil(side * scale / fill / STRIDE - 1e-6)) for side in (width, height)]
        w, h = (min(max(side, 2 * STRIDE), side_px) for side in sides)
        x0 = 0.5 * (box[0] + box[2] - w / scale)
        y0 = 0.5 * (box[1] + box[3] - h / scale)
        return cls(x0, y0, scale, _cropped(rgb, x0, y0, scale, (w, h)))

    def prior(self, mask: Mask) -> Float32:
        """Share of each of the prior's cells inside a mask of the whole image, (h / PRIOR_STRIDE, w / PRIOR_STRIDE)."""
        h, w = (side // PRIOR_STRIDE for side in self.rgb.shape[:2])
        return _cropped(mask.astype(np.float32), self.x0, self.y0, self.scale / PRIOR_STRIDE, (w, h))

    def in_image(self, log_odds: Float32, size: tuple[int, int]) -> Mask:
        """Where log-odds of this window are positive, in an image of size (width, height)."""
        s = self.scale
        M = np.array([[1 / s, 0, self.x0 + 0.5 / s - 0.5], [0, 1 / s, self.y0 + 0.5 / s - 0.5]])
        h, w = log_odds.shape
        x0, y0 = max(0, int(np.floor(self.x0))), max(0, int(np.floor(self.y0)))
        x1, y1 = min(size[0], int(np.ceil(self.x0 + w / s))), min(size[1], int(np.ceil(self.y0 + h / s)))
        out = np.zeros((size[1], size[0]), np.uint8)
        if x1 <= x0 or y1 <= y0:
            return out
        M[:, 2] -= (x0, y0)
        part = cv2.warpAffine(log_odds, M, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        out[y0:y1, x0:x1] = part > 0
        return out


def _cropped(image: np.ndarray, x0: float, y0: float, scale: float, size: tuple[int, int]) -> np.ndarray:
    """(h, w[, 3]) part of an image from a corner on, at a scale, black beyond; averaged where it is reduced."""
    factor = int(1 / scale)
    if factor >= 2:  # the warp samples points
        h, w = image.shape[0] // factor, image.shape[1] // factor
        image = cv2.resize(image[: h * factor, : w * factor], (w, h), interpolation=cv2.INTER_AREA)
        x0, y0, scale = x0 / factor, y0 / factor, scale * factor
    M = np.array([[scale, 0, (0.5 - x0) * scale - 0.5], [0, scale, (0.5 - y0) * scale - 0.5]])
    return cv2.warpAffine(image, M, size, flags=cv2.INTER_LINEAR)


class LearnedSegmenter:
    """See the module's text.

    Args:
        config: the whole configuration.
        target: the CAD model.

    Raises:
        WeightsError: ``segmentation.learned.weights`` is no such network.
    """

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._config = config.segmentation.learned
        weights = self._config.weights
        self._network = SegmentationNetwork(Path(weights).expanduser() if weights else None)
        self._renderer = RayRenderer(target)
        self._bank = SilhouetteBank(target, self._renderer)
        self.reset()

    def reset(self) -> None:
        """Forget earlier frames."""
        # Of the frame before the previous one, and of the previous one.
        self._masks: tuple[Mask | None, Mask | None] = (None, None)

    def update(self, frame: Frame, prior: PosePrior | None) -> Detection | None:
        """Find the target in one frame; None rather than a wrong mask."""
        expected = self._expected(frame, prior)
        mask = None if expected is None else self._track(frame.rgb, expected)
        if mask is None:
            mask = self._search(frame.rgb)
        self._masks = (self._masks[1], mask)
        return None if mask is None else Detection(mask.astype(bool))

    def _expected(self, frame: Frame, prior: PosePrior | None) -> Mask | None:
        """Where the target should be: the predicted silhouette, or else the previous mask."""
        if prior is not None and np.isfinite(prior.pose_row).all():
            silhouette = self._silhouette(frame, prior)
            if silhouette is not None:
                return silhouette
        before, last = self._masks
        return None if last is None else moved(last, *shift_between(before, last))

    def _silhouette(self, frame: Frame, prior: PosePrior) -> Mask | None:
        """The predicted silhouette (H, W), about as fine as a window; None when it is out of sight."""
        x0, y0, x1, y1 = self._renderer.pixel_bounds(prior.T_cam_target, frame.camera)
        if x0 >= x1 or y0 >= y1:
            return None
        step = max(1, round(max(x1 - x0, y1 - y0) / (_WINDOW_PX // PRIOR_STRIDE)))
        width, height = -(-(x1 - x0) // step) * step, -(-(y1 - y0) // step) * step
        part = self._renderer.quick_silhouette(prior.T_cam_target, frame.camera.crop(x0, y0, width, height, 1 / step))
        if not part.any():
            return None
        mask = np.zeros(frame.rgb.shape[:2], np.uint8)
        mask[y0:y1, x0:x1] = np.kron(part, np.ones((step, step), np.uint8))[: y1 - y0, : x1 - x0]
        return mask

    def _track(self, rgb: UInt8, expected: Mask) -> Mask | None:
        """The mask near an expected one; None when the image's own evidence is against it."""
        x, y, w, h = cv2.boundingRect(expected)
        window = Window.around(rgb, (x, y, x + w, y + h), _WINDOW_PX, _FILL)
        evidence, log_odds = self._network.with_prior(window.rgb, window.prior(expected))
        inside = log_odds > 0
        if not inside.any() or evidence[inside].mean() <= 0.0:
            return None
        mask = _sharpened(rgb, window.in_image(log_odds, (rgb.shape[1], rgb.shape[0])), 1.0 / window.scale)
        return mask if mask.any() else None

    def _search(self, rgb: UInt8) -> Mask | None:
        """The target from nothing: regions of evidence in the whole image, each looked at again in its window."""
        height, width = rgb.shape[:2]
        whole = Window.around(rgb, (0, 0, width, height), _SEARCH_PX)
        evidence = self._network.evidence(whole.rgb)
        best, best_shape = None, self._config.min_shape_overlap
        for box in _regions(evidence, whole):
            mask = self._closer_look(rgb, box)
            if mask is None:
                continue
            shape = self._bank.overlap(mask.astype(bool))
            if shape >= best_shape:
                best, best_shape = mask, shape
        return best

    def _closer_look(self, rgb: UInt8, box: Box) -> Mask | None:
        """The target around a box (x0, y0, x1, y1), first without a prior, then with what was found as prior."""
        window = Window.around(rgb, box, _WINDOW_PX, _FILL)
        evidence = self._network.evidence(window.rgb)
        if not (evidence > 0).any():
            return None
        return self._track(rgb, window.in_image(evidence, (rgb.shape[1], rgb.shape[0])))


def _sharpened(rgb: UInt8, mask: Mask, cell_px: float) -> Mask:
    """A mask whose outline is known to a cell of the window moved to where the image's colours change."""
    band = math.ceil(_BAND_CELLS * cell_px)
    x, y, w, h = cv2.boundingRect(mask)
    margin = 3 * band + 2
    box = np.s_[max(0, y - margin) : y + h + margin, max(0, x - margin) : x + w + margin]
    out = mask.copy()
    out[box] = refine_outline(np.ascontiguousarray(rgb[box]), np.ascontiguousarray(mask[box]), band, _MIN_CONTRAST)
    return out


def _regions(evidence: Float32, window: Window) -> list[Box]:
    """Boxes (x0, y0, x1, y1) in the image of regions of positive evidence, most evidence in all first."""
    positive = np.maximum(evidence, 0.0)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((positive > 0).astype(np.uint8), connectivity=8)
    total = np.bincount(labels.ravel(), positive.ravel(), minlength=count)
    total[0] = 0.0
    boxes = []
    for label in np.argsort(-total)[:_MAX_REGIONS]:
        if total[label] <= 0:
            break
        x, y, w, h = stats[label, :4] / window.scale
        x0, y0 = x + window.x0, y + window.y0
        boxes.append((int(x0), int(y0), int(x0 + w + 1), int(y0 + h + 1)))
    return boxes
