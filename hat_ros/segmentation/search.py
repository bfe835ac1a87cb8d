"""Finding the target before a textured background from nothing, and judging any mask on its own merits."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.config import ClassicalConfig
from hat_ros.segmentation import region
from hat_ros.segmentation.boundary import refine_outline
from hat_ros.segmentation.ground import CLEAR, GroundMemory
from hat_ros.segmentation.masks import Mask, Window, shrink, touched_sides, touches_border
from hat_ros.segmentation.motion import MotionDetector, MotionEvidence
from hat_ros.segmentation.outlines import SharpOutlines, is_grey
from hat_ros.segmentation.shape import SilhouetteBank
from hat_ros.target.masks import overlap

MIN_CONTRAST = 8.0  # 8-bit colour step across the outline below which there is no outline
OPEN_BETTER = 0.012  # plausibility by which a cut that takes a liberty must beat the one that does not
AGREEMENT = 0.8  # overlap of two independent masks that mean the same target
_CHECK_ITERATIONS = 1  # of a cut that is only to agree so far
# A target contains most of what moves against the background, and hardly any texture that moves with it. Every
# hundredth short of that costs a hundredth of shape overlap; ...
_MIN_FOUND = 0.6
_MAX_STILL = 0.4
_FOUND_BONUS = 0.1
_MOTION_RELIEF = 0.1  # ... a mask that motion could have contradicted needs less, ...
_COARSE_BENEFIT = 0.15  # ... and one that misses this little gets a closer look; ...
CUT_SURCHARGE = 0.1  # ... one that the border cuts needs more, since part of a silhouette fits many things.
_UNMOVED_SURCHARGE = 0.16
# Where there is no colour a mask is the more plausible the more of the sharp outlines it holds, beyond this share.
_SHARP_WEIGHT, _SHARP_USUAL = 0.3, 0.6
_GROUND_RELIEF = 0.25  # what stands before ground known all around needs still less
_GROUND_SIDE_PX = 160  # longer side of the image searched for it
_GAP_PX = 5  # between pieces of one target
# How far an outline may move within a frame, of the target's length: 4 degrees and then some; and in pixels.
_MARGIN_SHARE = 0.05
_MARGIN_PX = 2.0


@dataclass(frozen=True)
class Found:
    """What a search from nothing found.

    Attributes:
        mask: (H, W) uint8 of 0 and 1.
        plausibility: see :meth:`Search.plausibility`.
        contrast: colour step across the outline.
        models: colours of both sides.
    """

    mask: Mask
    plausibility: float
    contrast: float
    models: region.ColorModels


@dataclass(frozen=True)
class _Newest:
    """The newest frame at the scale of a search, reduced on demand."""

    rgb: UInt8
    remembered: Window
    detector: MotionDetector
    side_px: int

    @cached_property
    def window(self) -> Window:
        """The whole image."""
        return Window.whole(self.rgb, self.side_px, self.remembered)

    @cached_property
    def motion(self) -> MotionEvidence | None:
        """What moved."""
        return self.detector.evidence()

    @cached_property
    def sharp(self) -> SharpOutlines | None:
        """The sharp outlines of an image without colour."""
        if not is_grey(self.remembered.rgb):
            return None
        grey = np.ascontiguousarray(self.remembered.rgb[..., 0])
        return SharpOutlines(grey, (self.window.rgb.shape[1], self.window.rgb.shape[0]))


class Search:
    """Remembers how the background moves and finds what is not it.

    Attributes:
        ground: what is known of the background.
    """

    def __init__(self, config: ClassicalConfig, bank: SilhouetteBank) -> None:
        self._config = config
        self._bank = bank
        self.ground = GroundMemory()
        self.reset()

    def reset(self) -> None:
        """Forget earlier frames."""
        self._motion = MotionDetector(self._config.cold_side_px)
        self.ground.reset()
        self._turn = 0

    def push(self, rgb: UInt8, mask_before: Mask | None = None) -> None:
        """Show it the newest image, (H, W, 3) uint8, and the previous one's mask; to be called once per frame."""
        remembered = self.ground.push(rgb, mask_before)
        self._newest = _Newest(rgb, remembered, self._motion, self._config.cold_side_px)
        self._motion.push(remembered.rgb)

    def judge(self, mask: Mask) -> tuple[float, float]:
        """Plausibility of a full-resolution mask in the newest image, and what a new find would need."""
        small = shrink(mask, self._config.cold_side_px)
        motion = self._newest.motion
        return self._plausibility(small, motion), self._required(small, motion)

    def confirms(self, mask: Mask) -> bool:
        """Whether a single cut from nothing finds the target where a full-resolution mask has it.

        A fraction of the work of :meth:`find`, whose kinds of cuts take turns. Disagreement alone means little.
        """
        small = shrink(mask, self._config.cold_side_px)
        kinds: list[str | None] = list(touched_sides(mask)) or [None]
        motion = self._newest.motion if self._turn % 2 else None
        kind = kinds[self._turn // 2 % len(kinds)]
        self._turn += 1
        if motion is not None:
            cut = region.cut_from_motion(self._newest.window.rgb, motion.moving, _CHECK_ITERATIONS)
        else:
            cut = region.cut_from_nothing(self._newest.window.rgb, kind, small, _CHECK_ITERATIONS)
        return cut is not None and overlap(cut, small) >= AGREEMENT

    def find(self, rgb: UInt8, open_sides: tuple[str, ...]) -> Found | None:
        """Find the target from nothing.

        Args:
            rgb: the newest image, as pushed.
            open_sides: sides of the image at which it may be cut off.
        """
        found = self.before_ground(rgb)
        if found is not None:
            return found
        whole = self._newest.window
        motion = self._newest.motion
        sharp = self._newest.sharp
        cuts = _cold_cuts(whole.rgb, motion, open_sides) + (sharp.cuts() if sharp is not None else [])
        # Without motion an open side may let the background in: the first, closed cut is the safest.
        margin = OPEN_BETTER if motion is None else 0.0
        best, best_score = None, -np.inf
        step = region.color_step(whole.rgb)
        for cut in cuts:
            if cut is None or region.edge_contrast(step, cut) < max(MIN_CONTRAST, region.chance_contrast(step, cut)):
                continue
            score = self._plausibility(cut, motion)
            if score >= max(self._required(cut, motion) - _COARSE_BENEFIT, best_score + margin):
                best, best_score = cut, score
        if best is None:
            return None
        required = self._required(best, motion)
        mask = whole.enlarge(best)
        x, y, w, h = cv2.boundingRect(mask)
        margin = margin_px(mask)
        window = Window.around(rgb, (x, y, x + w, y + h), 2.5 * margin, self._config.work_side_px)
        if window is None:
            return None
        models = region.ColorModels()
        seed = window.reduce(mask)
        cut = region.cut_from_seeds(window.rgb, [seed], margin * window.scale, models)
        if sharp is not None and (cut is None or self._shape(cut) < self._shape(seed)):
            cut = seed  # greys alone find less than outlines did
        if cut is None:
            return None
        if best_score < required:
            # A small target's shape is lost at the scale of the search: judge what a closer look finds.
            best_score += self._shape(cut) - self._shape(best)
            if best_score < required:
                return None
        contrast = region.edge_contrast(region.color_step(window.rgb), cut)
        return Found(at_full_resolution(rgb, window, cut), best_score, contrast, models)

    def around(self, rgb: UInt8, silhouette: Mask) -> Found | None:
        """The target where a pose that the image has supported says that it is; None unless it shows there."""
        x, y, w, h = cv2.boundingRect(silhouette)
        margin = margin_px(silhouette)
        window = Window.around(rgb, (x, y, x + w, y + h), 2.5 * margin, self._config.work_side_px)
        if window is None:
            return None
        seed, models = window.reduce(silhouette), region.ColorModels()
        seen = self.ground.evidence(window, max(w, h))
        cut = region.cut_from_seeds(window.rgb, [seed], margin * window.scale, models, seen)
        if cut is None or (seen is not None and seen.contradicts(cut)):
            return None
        agreement, sighted = overlap(cut, seed), seen is not None and seen.shows(cut)
        if agreement < (self._config.min_prior_overlap if sighted else AGREEMENT):
            return None
        step = region.color_step(window.rgb)
        contrast = region.edge_contrast(step, cut)
        if contrast < max(MIN_CONTRAST, region.chance_contrast(step, cut)):
            return None
        mask = at_full_resolution(rgb, window, cut)
        plausibility, required = self.judge(mask)
        return Found(mask, plausibility, contrast, models) if plausibility >= required else None

    def before_ground(self, rgb: UInt8) -> Found | None:
        """What stands before the ground, once so much of that is known that it is the whole target."""
        whole = Window.whole(rgb, _GROUND_SIDE_PX)
        length_px = self.ground.length_known_px(whole)
        seen = self.ground.evidence(whole, length_px) if length_px > 0 else None
        if seen is None:
            return None
        kernel = np.ones((_GAP_PX, _GAP_PX), np.uint8)
        joined = np.asarray(cv2.morphologyEx(seen.target, cv2.MORPH_CLOSE, kernel), np.uint8)
        pieces = [piece for piece in (region.tidy(joined, None), region.tidy(joined, joined)) if piece is not None]
        piece = max(pieces, key=self._shape, default=None)
        if piece is None:
            return None
        x, y, w, h = cv2.boundingRect(whole.enlarge(piece))
        if max(w, h) > CLEAR * length_px:
            return None
        margin = _MARGIN_PX + _MARGIN_SHARE * max(w, h)
        window = Window.around(rgb, (x, y, x + w, y + h), 2.5 * margin, self._config.work_side_px)
        if window is None:
            return None
        seen, models = self.ground.evidence(window, length_px), region.ColorModels()
        if seen is None:
            return None
        cut = region.cut_from_seeds(
            window.rgb, [window.reduce(whole.enlarge(piece))], margin * window.scale, models, seen
        )
        if cut is None or not seen.confirms(cut):
            return None
        plausibility = self._shape(cut)
        if plausibility < self._config.min_shape_overlap - _GROUND_RELIEF:
            return None
        contrast = region.edge_contrast(region.color_step(window.rgb), cut)
        return Found(at_full_resolution(rgb, window, cut), plausibility, contrast, models)

    def _plausibility(self, mask: Mask, motion: MotionEvidence | None) -> float:
        """How well a mask at the scale of a search is explained: its overlap with the nearest CAD silhouette, less
        the doubt that motion raises: where something moves it is not, or what it holds moves with the background; and
        that sharp outlines beside it raise where there is no colour."""
        doubt = 0.0
        held = None if self._newest.sharp is None else self._newest.sharp.held_beyond_chance(mask)
        if held is not None:
            doubt += _SHARP_WEIGHT * (_SHARP_USUAL - held)
        if motion is not None:
            found = motion.found_share(mask)
            doubt += max(0.0, _MIN_FOUND - found) + _FOUND_BONUS * (1.0 - found)
            doubt += max(0.0, motion.still_share(mask) - _MAX_STILL)
        return self._shape(mask) - doubt

    def _shape(self, mask: Mask) -> float:
        """Overlap of a mask with the nearest CAD silhouette."""
        return self._bank.overlap(mask.astype(bool))

    def _required(self, mask: Mask, motion: MotionEvidence | None) -> float:
        """Plausibility that a mask needs: less where motion has its say, more where the border hides a part."""
        required = self._config.min_shape_overlap
        if motion is not None:
            required -= _MOTION_RELIEF
        if not touches_border(mask):
            return required
        # So does most of the background, and nothing contradicts it before it has moved.
        return required + (CUT_SURCHARGE if motion is not None else _UNMOVED_SURCHARGE)


def _cold_cuts(rgb: UInt8, motion: MotionEvidence | None, open_sides: tuple[str, ...]) -> list[Mask | None]:
    """The closed cut, the one from motion if there is any, and one for each open side that the closed cut is near.

    Two at a time: a search takes as long as several frames and must not hold up the next one for longer than it has to.
    Each cut seeds the generator of its own thread, so which runs where does not matter.
    """
    with ThreadPoolExecutor(2) as pool:
        cuts = [pool.submit(region.cut_from_nothing, rgb)]
        if motion is not None:
            cuts.append(pool.submit(region.cut_from_motion, rgb, motion.moving))
        closed = cuts[0].result()
        near = open_sides if closed is None else region.near_sides(closed)
        cuts += [pool.submit(region.cut_from_nothing, rgb, side, closed) for side in open_sides if side in near]
        return [cut.result() for cut in cuts]


def margin_px(mask: Mask) -> float:
    """How far the outline of a mask may move within a frame, in pixels."""
    _, _, w, h = cv2.boundingRect(mask)
    return _MARGIN_PX + _MARGIN_SHARE * max(w, h)


def at_full_resolution(rgb: UInt8, window: Window, cut: Mask) -> Mask:
    """A cut in a window as an (H, W) mask, its outline found anew at full resolution."""
    rows, cols = slice(window.y0, window.y0 + window.height), slice(window.x0, window.x0 + window.width)
    band = max(2, round(1 / window.scale) + 1)
    mask = np.zeros(rgb.shape[:2], np.uint8)
    mask[rows, cols] = refine_outline(np.ascontiguousarray(rgb[rows, cols]), window.enlarge(cut), band, MIN_CONTRAST)
    return mask
