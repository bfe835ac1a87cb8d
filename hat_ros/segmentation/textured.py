"""Following the target before a textured background from frame to frame, with checks that it is still the target."""

from __future__ import annotations

import cv2
import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.config import ClassicalConfig
from hat_ros.segmentation import region
from hat_ros.segmentation.boundary import warm_up
from hat_ros.segmentation.ground import GroundEvidence
from hat_ros.segmentation.masks import SIDES, Mask, Window, moved, shift_between, touched_sides
from hat_ros.segmentation.search import (
    AGREEMENT,
    MIN_CONTRAST,
    OPEN_BETTER,
    Found,
    Search,
    at_full_resolution,
    margin_px,
)
from hat_ros.segmentation.shape import SilhouetteBank
from hat_ros.target.masks import overlap

_MAX_AREA_CHANGE = 1.6  # from one frame to the next
_MIN_CONTINUITY = 0.6  # overlap of a tracked mask with its seed
_MIN_CONTRAST_KEPT = 0.4  # share of its usual contrast at which a tracked outline is lost
_CONTRAST_GAIN = 0.2
_SAME = 0.95  # overlap of two masks that are the same
_NEARLY_SAME = 0.9
_BENEFIT_OF_DOUBT = 0.1  # less plausibility keeps a mask than finds one
_CLEARLY_BETTER = 0.025  # plausibility by which another explanation must beat a predicted one
_MAX_RETRY_FRAMES = 8
_CHECK_UNAIDED_FRAMES = 3  # between checks of a mask that no prior holds in place; more while they find the same
_STEADY = 0.87  # overlap of a tracked mask with its moved predecessor below which something happened


class TexturedBackground:
    """Finds and follows the target before anything but a black sky."""

    def __init__(self, config: ClassicalConfig, bank: SilhouetteBank) -> None:
        self._config = config
        self._bank = bank
        self._search = Search(config, bank)
        warm_up()
        self.reset()

    def reset(self) -> None:
        """Forget earlier frames."""
        self._search.reset()
        self._models = region.ColorModels()
        self._contrast = 0.0  # of the tracked outline, slowly following
        self._since_check = 0
        self._check_every = _CHECK_UNAIDED_FRAMES
        self._unconfirmed = False  # the last quick check found something else: a search is due
        self._on_ground = False  # the ground behind the tracked mask confirms it
        self._found_anew = False  # the previous mask: the one before it tells nothing about its motion
        self._failures = 0
        self._wait = 0

    def find(
        self,
        rgb: UInt8,
        masks: tuple[Mask | None, Mask | None],
        silhouette: Mask | None,
        trusted: bool,
    ) -> Mask | None:
        """The target's mask, (H, W) uint8 of 0 and 1.

        Args:
            rgb: (H, W, 3) uint8 image.
            masks: those of the frame before the previous one and of the previous one.
            silhouette: prediction, None without one.
            trusted: whether an image has supported the prediction.
        """
        self._search.push(rgb, masks[1])
        if masks[1] is not None:
            shift_xy = (0, 0) if self._found_anew else shift_between(*masks)
            self._found_anew = False
            tracked, aided = self._track(rgb, masks[1], shift_xy, silhouette, trusted)
            self._since_check += 1
            if tracked is not None and self._on_ground:
                return self._look_around(rgb, tracked) if self._since_check >= self._check_every else tracked
            if tracked is not None:
                due = self._since_check >= (self._config.check_interval_frames if aided else self._check_every)
                doubtful = self._since_check >= _CHECK_UNAIDED_FRAMES
                due = due or self._unconfirmed or (doubtful and overlap(tracked, moved(masks[1], *shift_xy)) < _STEADY)
                return self._cross_check(rgb, tracked, aided, silhouette) if due else tracked
        if trusted and silhouette is not None:
            found = self._search.around(rgb, silhouette)
            if found is not None:
                return self._adopt(found)
        if self._wait > 0:
            self._wait -= 1
            return None
        found = self._search.find(rgb, SIDES)
        if found is None:
            self._failures += 1
            self._wait = min(2**self._failures, _MAX_RETRY_FRAMES) - 1
            return None
        self._failures = 0
        return self._adopt(found)

    def _adopt(self, found: Found) -> Mask:
        """Go on from what a search found."""
        self._since_check = 0
        self._unconfirmed = False
        self._found_anew = True
        self._models = found.models
        self._contrast = found.contrast
        return found.mask

    def _track(
        self, rgb: UInt8, mask: Mask, shift_xy: tuple[int, int], silhouette: Mask | None, trusted: bool
    ) -> tuple[Mask | None, bool]:
        """Follow the previous mask into this frame; the predicted silhouette helps while the two agree.

        Returns:
            The mask, None when it was lost, and whether a trusted prediction helped.
        """
        dx, dy = shift_xy
        x, y, w, h = cv2.boundingRect(mask)
        box = (x + dx, y + dy, x + w + dx, y + h + dy)
        margin = margin_px(mask)
        if silhouette is not None and overlap(silhouette, moved(mask, dx, dy)) < self._config.min_prior_overlap:
            silhouette = None
        if silhouette is not None:
            u, v, a, b = cv2.boundingRect(silhouette)
            box = (min(box[0], u), min(box[1], v), max(box[2], u + a), max(box[3], v + b))
        window = Window.around(rgb, box, 2.5 * margin, self._config.work_side_px)
        if window is None:
            return None, False
        previous = window.reduce(mask, shift_xy)
        predicted = None if silhouette is None else window.reduce(silhouette)
        seen = self._search.ground.evidence(window, max(w, h))
        best, aided = self._best_cut(window, previous, predicted, trusted, margin, seen)
        self._on_ground = best is not None and best.confirmed
        if best is None:
            return None, aided
        self._contrast += _CONTRAST_GAIN * (best.contrast - self._contrast)
        return at_full_resolution(rgb, window, best.mask), aided

    def _best_cut(
        self,
        window: Window,
        previous: Mask,
        predicted: Mask | None,
        trusted: bool,
        margin: float,
        seen: GroundEvidence | None,
    ) -> tuple[region.ClearCut | None, bool]:
        """Cut from the reduced previous mask, and from the reduced predicted silhouette besides.

        Without the prediction the cut has less freedom, with it it cannot drift. A trusted prediction is followed,
        unless it leads away from the previous mask to nothing more plausible; one without support where it
        makes the mask more plausible and its outline no less clear.

        Returns:
            The cut, None when both failed, and whether a trusted prediction helped.
        """
        alone = [previous]
        if predicted is None:
            return self._cut(window, alone, margin, self._models, seen), False
        both, tried = [predicted, previous], self._models.copy()
        best = self._cut(window, both if trusted else alone, margin, self._models, seen)
        if best is not None and (best.confirmed or (trusted and overlap(best.mask, previous) >= _STEADY)):
            return best, trusted
        other = self._cut(window, alone if trusted else both, margin, tried, seen)
        if other is not None:
            replaces = best is None or (not self._is_better(best, other) if trusted else self._is_better(other, best))
            if replaces:
                self._models = tried
                return other, False
        return best, trusted

    def _cut(
        self,
        window: Window,
        seeds: list[Mask],
        margin: float,
        models: region.ColorModels,
        seen: GroundEvidence | None,
    ) -> region.ClearCut | None:
        """Cut from reduced seeds, the last of them the previous mask; None when it leads away or loses contrast.

        What is seen of the ground helps, unless it leads away: a part of it that is not known yet looks like target.
        """
        if seen is not None:
            aware = models.copy()
            cut = region.cut_from_seeds(window.rgb, seeds, margin * window.scale, aware, seen)
            clear = self._checked(window, seeds, cut, seen)
            if clear is not None:
                models.adopt(aware)
                return clear
        cut = region.cut_from_seeds(window.rgb, seeds, margin * window.scale, models)
        return self._checked(window, seeds, cut, seen)

    def _checked(
        self, window: Window, seeds: list[Mask], cut: Mask | None, seen: GroundEvidence | None
    ) -> region.ClearCut | None:
        """A cut from seeds with its contrast; None if it leads away or loses contrast and no ground confirms it."""
        if cut is None:
            return None
        contrast = region.edge_contrast(region.color_step(window.rgb), cut)
        if seen is not None:
            if seen.confirms(cut):
                return region.ClearCut(cut, contrast, confirmed=True)
            if seen.contradicts(cut):
                return None
        grown = np.count_nonzero(cut) / max(1, int(np.count_nonzero(seeds[-1])))
        if not 1 / _MAX_AREA_CHANGE <= grown <= _MAX_AREA_CHANGE or overlap(cut, seeds[0]) < _MIN_CONTINUITY:
            return None
        if contrast < max(MIN_CONTRAST, _MIN_CONTRAST_KEPT * self._contrast):
            return None
        return region.ClearCut(cut, contrast)

    def _is_better(self, other: region.ClearCut, than: region.ClearCut) -> bool:
        gain = self._bank.overlap(other.mask.astype(bool)) - self._bank.overlap(than.mask.astype(bool))
        return other.contrast >= than.contrast and gain >= OPEN_BETTER

    def _look_around(self, rgb: UInt8, tracked: Mask) -> Mask:
        """A mask that the ground confirms, unless more of the target stands before the ground beyond it."""
        self._since_check = 0
        found = self._search.before_ground(rgb)
        if found is not None and overlap(found.mask, tracked) < _NEARLY_SAME:
            self._check_every = _CHECK_UNAIDED_FRAMES
            return self._adopt(found)
        self._check_every = min(2 * self._check_every, self._config.check_interval_frames)
        return tracked

    def _cross_check(self, rgb: UInt8, tracked: Mask, aided: bool, silhouette: Mask | None) -> Mask | None:
        """Compare a tracked mask with what a search from nothing finds; keep the more plausible one.

        A mask held in place by a prediction is given up only for one that means something else; while a quick check
        finds the same, nothing more is searched. A check and a search take as long as several frames, so the search
        waits for the next one. What agrees with a prediction, trusted or not, must be clearly beaten.
        """
        self._since_check = 0
        if aided and not self._unconfirmed:
            self._unconfirmed = not self._search.confirms(tracked)
            return tracked
        self._unconfirmed = False
        found = self._search.find(rgb, touched_sides(tracked))
        agreement = 0.0 if found is None else overlap(found.mask, tracked)
        longer = min(2 * self._check_every, self._config.check_interval_frames)
        self._check_every = longer if agreement >= _SAME else _CHECK_UNAIDED_FRAMES
        if aided and agreement >= AGREEMENT:
            return tracked
        plausibility, required = self._search.judge(tracked)
        if found is not None:
            expected = aided or (
                silhouette is not None and overlap(tracked, silhouette) > overlap(found.mask, silhouette)
            )
            if found.plausibility > plausibility + (_CLEARLY_BETTER if expected else 0.0):
                return self._adopt(found)
        return tracked if aided or plausibility >= required - _BENEFIT_OF_DOUBT else None
