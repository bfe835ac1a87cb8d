"""Segmentation without weights: ``segmentation.backend: classical``.

Before black sky a threshold finds what is lit. Before anything else (Earth, clouds, a laboratory) a graph cut separates
the target, seeded by the previous mask and by the silhouette of the predicted pose, or from nothing. What it says is
checked against the CAD model's silhouettes, and a tracked mask now and then against an independent search, so that a
wrong mask does not keep itself alive.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hat_ros.config import HatConfig
from hat_ros.render import create_renderer
from hat_ros.segmentation import region, sky
from hat_ros.segmentation.boundary import refine_outline
from hat_ros.segmentation.motion import MotionDetector, MotionEvidence
from hat_ros.segmentation.shape import SilhouetteBank
from hat_ros.target import Target
from hat_ros.types import Detection, Frame, PosePrior

Mask = NDArray[np.uint8]

_SIDES = ("top", "bottom", "left", "right")
# The motion of an outline from one frame to the next, of the target's length: 4 degrees per frame and then some.
_MARGIN_SHARE = 0.05
_MARGIN_PX = 2.0
_MAX_AREA_CHANGE = 1.6  # from one frame to the next
_MIN_CONTINUITY = 0.6  # overlap of a tracked mask with its seed
_MIN_CONTRAST = 8.0  # 8-bit colour step across the outline below which there is no outline
_MIN_CONTRAST_KEPT = 0.4  # share of its usual contrast at which a tracked outline is lost
_CONTRAST_GAIN = 0.2
_AGREEMENT = 0.8  # overlap of two independent masks that mean the same target
_SAME = 0.95  # overlap of two masks that are the same
# A target contains most of what moves against the background, and hardly any texture that moves with it. Every
# hundredth short of that costs a hundredth of shape overlap; ...
_MIN_FOUND = 0.6
_MAX_STILL = 0.25
_FOUND_BONUS = 0.1
_MOTION_RELIEF = 0.1  # ... a mask that motion could have spoken against needs less, ...
_CUT_SURCHARGE = 0.1  # ... one that the border cuts needs more, since part of a silhouette fits many things.
_BENEFIT_OF_DOUBT = 0.1  # less plausibility keeps a mask than finds one
_OPEN_BETTER = 0.012  # plausibility by which a cut with an open side must beat the closed one
_CLEARLY_BETTER = 0.025  # plausibility by which one explanation must beat the simpler one
# A second bright region with this share of the largest makes the choice a question; less where the border cuts the
# largest, which may then be a planet.
_RIVAL_SHARE = 0.2
_RIVAL_SHARE_CUT = 0.03
_MIN_LIT_SHAPE = 0.5  # shape overlap of the lit part of a target
_MAX_CONTACT = 0.4  # share of its outline that the image border may cut off a target
_SCATTERED_GAIN = 0.1  # shape overlap that bridging the gaps between lit parts must bring
_MAX_RETRY_FRAMES = 8
_CHECK_UNAIDED_FRAMES = 3  # between checks of a mask that no prior holds in place; more while they find the same


@dataclass(frozen=True)
class _Window:
    """A part of the image at reduced scale: full-resolution corner and size, reduced size, reduced colours."""

    x0: int
    y0: int
    width: int
    height: int
    scale: float
    rgb: NDArray[np.uint8]

    def reduce(self, mask: Mask, shift_xy: tuple[int, int] = (0, 0)) -> Mask:
        """This window of a full-resolution 0/1 mask, moved by whole pixels, at reduced scale."""
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
        """A reduced 0/1 mask at full resolution, this window only."""
        return (cv2.resize(mask * 255, (self.width, self.height), interpolation=cv2.INTER_LINEAR) > 127).astype(
            np.uint8
        )


@dataclass(frozen=True)
class _Found:
    """What a search from nothing found.

    Attributes:
        mask: (H, W) uint8 of 0 and 1.
        plausibility: see ``ClassicalSegmenter._plausibility``.
        contrast: colour step across the outline.
        models: colours of both sides.
    """

    mask: Mask
    plausibility: float
    contrast: float
    models: region.ColorModels


class ClassicalSegmenter:
    """See the module's text.

    Args:
        config: the whole configuration.
        target: the CAD model, whose silhouettes tell what a mask can look like.
    """

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._config = config.segmentation.classical
        self._renderer = create_renderer("embree", target)
        self._bank = SilhouetteBank(target, self._renderer)
        self.reset()

    def reset(self) -> None:
        """Forget the previous masks."""
        self._mask: Mask | None = None  # of the previous frame
        self._before: Mask | None = None  # of the frame before that
        self._motion = MotionDetector()
        self._models = region.ColorModels()
        self._contrast = 0.0  # of the tracked outline, slowly following
        self._since_check = 0
        self._check_every = _CHECK_UNAIDED_FRAMES
        self._failures = 0
        self._wait = 0

    def update(self, frame: Frame, prior: PosePrior | None) -> Detection | None:
        """Find the target in one frame; None rather than a wrong mask."""
        mask = None
        measured = sky.measure_sky(frame.rgb)
        if measured.border_share >= self._config.sky_border_share:
            mask = self._before_sky(measured, frame, prior)
        else:
            mask = self._before_texture(frame, prior)
        if mask is not None and not mask.any():
            mask = None
        self._before, self._mask = self._mask, mask
        return None if mask is None else Detection(mask.astype(bool))

    # Black sky -------------------------------------------------------------------------------------------------

    def _before_sky(self, measured: sky.Sky, frame: Frame, prior: PosePrior | None) -> Mask | None:
        regions = sky.lit_regions(measured)
        if not regions:
            return None
        sizes = [np.count_nonzero(r) for r in regions]
        main: int | None = 0
        silhouette = self._silhouette(frame, prior if prior is not None and prior.healthy else None)
        cut = sky.touches_border(regions[0])
        rivals = [i for i, size in enumerate(sizes) if size >= (_RIVAL_SHARE_CUT if cut else _RIVAL_SHARE) * sizes[0]]
        if cut or len(rivals) > 1:
            main = self._choose_region(regions, rivals, silhouette)
            if main is None:
                return self._before_texture(frame, prior)
        lit = sky.join_parts(regions, main)
        body = self._complete(measured, lit)
        if silhouette is not None and _explains(silhouette, lit, body):
            return lit | _shadowed(silhouette, lit)
        return body

    def _complete(self, measured: sky.Sky, lit: Mask) -> Mask:
        """The body of which ``lit`` are the lit parts: ``lit`` itself unless it is scattered over a CAD silhouette."""
        if not sky.is_scattered(lit):
            return lit
        options = sky.bridge_gaps(measured, lit, self._config.work_side_px)
        shapes = [self._bank.overlap(option) for option in options]
        best = int(np.argmax(shapes))
        if shapes[best] < shapes[0] + _SCATTERED_GAIN:
            return lit
        size = (lit.shape[1], lit.shape[0])
        large = cv2.resize(options[best].astype(np.uint8) * 255, size, interpolation=cv2.INTER_LINEAR)
        return lit | (large > 127).astype(np.uint8)

    def _choose_region(self, regions: list[Mask], rivals: list[int], silhouette: Mask | None) -> int | None:
        """Which bright region is the target: the one that is where it was, or else the one with its shape.

        A planet, too, is a bright region, always cut by the image border; so one that the border does not cut is
        preferred, and a cut one must not be mostly border. None when no region will do.
        """
        for known in (self._mask, silhouette):
            if known is not None:
                shared = {i: np.count_nonzero(regions[i] & known) for i in rivals}
                most = max(rivals, key=lambda i: shared[i])
                size = np.count_nonzero(regions[most])
                if shared[most] >= _MIN_CONTINUITY * size and size <= _MAX_AREA_CHANGE * np.count_nonzero(known):
                    return most
        shape = {i: self._bank.overlap(_shrink(regions[i], self._config.cold_side_px).astype(bool)) for i in rivals}
        whole = [i for i in rivals if not sky.touches_border(regions[i])]
        best = max(whole, key=lambda i: shape[i], default=None)
        if best is not None and (shape[best] >= _MIN_LIT_SHAPE or len(whole) == len(rivals)):
            return best
        required = self._config.min_shape_overlap + _CUT_SURCHARGE
        cut = [i for i in rivals if shape[i] >= required and region.border_contact(regions[i]) <= _MAX_CONTACT]
        return max((i for i in cut if i not in whole), key=lambda i: shape[i], default=best)

    # Anything else ---------------------------------------------------------------------------------------------

    def _before_texture(self, frame: Frame, prior: PosePrior | None) -> Mask | None:
        self._motion.push(self._whole(frame).rgb)
        if self._mask is not None:
            tracked, aided = self._track(frame, prior)
            self._since_check += 1
            due = self._since_check >= (self._config.check_interval_frames if aided else self._check_every)
            if tracked is not None and not due:
                return tracked
            if tracked is not None:
                self._since_check = 0
                return self._cross_check(frame, tracked, aided)
        if self._wait > 0:
            self._wait -= 1
            return None
        found = self._search(frame, _SIDES)
        if found is None:
            self._failures += 1
            self._wait = min(2**self._failures, _MAX_RETRY_FRAMES) - 1
            return None
        self._failures = 0
        return self._adopt(found)

    def _adopt(self, found: _Found) -> Mask:
        """Go on from what a search found."""
        self._since_check = 0
        self._models = found.models
        self._contrast = found.contrast
        return found.mask

    def _track(self, frame: Frame, prior: PosePrior | None) -> tuple[Mask | None, bool]:
        """Follow the previous mask into this frame; the predicted silhouette helps while the two agree.

        A prediction that nobody vouches for yet is tried as well: it is followed where it makes the mask more
        plausible and its outline no less clear.

        Returns:
            The mask, None when it was lost, and whether a healthy prediction helped.
        """
        assert self._mask is not None
        dx, dy = self._shift()
        x, y, w, h = cv2.boundingRect(self._mask)
        box = (x + dx, y + dy, x + w + dx, y + h + dy)
        margin = _MARGIN_PX + _MARGIN_SHARE * max(w, h)
        silhouette = self._silhouette(frame, prior)
        if silhouette is not None:
            if _overlap(silhouette, _moved(self._mask, dx, dy)) < self._config.min_prior_overlap:
                silhouette = None
            else:
                u, v, a, b = cv2.boundingRect(silhouette)
                box = (min(box[0], u), min(box[1], v), max(box[2], u + a), max(box[3], v + b))
        window = self._window(frame, box, 2.5 * margin)
        if window is None:
            return None, False
        before = window.reduce(self._mask, (dx, dy))
        expected = None if silhouette is None else window.reduce(silhouette)
        aided = expected is not None and prior is not None and prior.healthy
        tried = region.ColorModels(self._models.background.copy(), self._models.foreground.copy())
        best = self._cut(window, [before] if not aided else [expected, before], margin, self._models)
        if expected is not None and not aided:
            other = self._cut(window, [expected, before], margin, tried)
            if other is not None and (best is None or self._is_better(other, best)):
                best, self._models = other, tried
        if best is None:
            return None, aided
        self._contrast += _CONTRAST_GAIN * (best.contrast - self._contrast)
        return self._finish(frame, window, best.mask), aided

    def _cut(
        self, window: _Window, seeds: list[Mask], margin: float, models: region.ColorModels
    ) -> region.ClearCut | None:
        """Cut from reduced seeds, the last of them the previous mask; None when it leads away or loses contrast."""
        cut = region.cut_from_seeds(window.rgb, seeds, margin * window.scale, models)
        if cut is None:
            return None
        grown = np.count_nonzero(cut) / max(1, np.count_nonzero(seeds[-1]))
        if not 1 / _MAX_AREA_CHANGE <= grown <= _MAX_AREA_CHANGE or _overlap(cut, seeds[0]) < _MIN_CONTINUITY:
            return None
        contrast, _ = region.edge_contrast(window.rgb, cut)
        if contrast < max(_MIN_CONTRAST, _MIN_CONTRAST_KEPT * self._contrast):
            return None
        return region.ClearCut(cut, contrast)

    def _is_better(self, other: region.ClearCut, than: region.ClearCut) -> bool:
        gain = self._bank.overlap(other.mask.astype(bool)) - self._bank.overlap(than.mask.astype(bool))
        return other.contrast >= than.contrast and gain >= _OPEN_BETTER

    def _shift(self) -> tuple[int, int]:
        """Whole pixels (x, y) that the target moved in the last frame; none while the image border cuts it."""
        if self._mask is None or self._before is None:
            return 0, 0
        if sky.touches_border(self._mask) or sky.touches_border(self._before):
            return 0, 0
        dx, dy = np.rint(_centroid(self._mask) - _centroid(self._before))
        return int(dx), int(dy)

    def _cross_check(self, frame: Frame, tracked: Mask, aided: bool) -> Mask | None:
        """Compare a tracked mask with what a search from nothing finds; keep the more plausible one.

        A mask held in place by a prediction is given up only for one that means something else.
        """
        found = self._search(frame, _touched_sides(tracked))
        agreement = 0.0 if found is None else _overlap(found.mask, tracked)
        longer = min(2 * self._check_every, self._config.check_interval_frames)
        self._check_every = longer if agreement >= _SAME else _CHECK_UNAIDED_FRAMES
        if aided and agreement >= _AGREEMENT:
            return tracked
        small = _shrink(tracked, self._config.cold_side_px)
        motion = self._motion.evidence()
        plausibility = self._plausibility(small, motion)
        if found is not None and found.plausibility > plausibility + (_CLEARLY_BETTER if aided else 0.0):
            return self._adopt(found)
        kept = aided or plausibility >= self._required(small, motion) - _BENEFIT_OF_DOUBT
        return tracked if kept else None

    def _plausibility(self, mask: Mask, motion: MotionEvidence | None) -> float:
        """How well a mask at the scale of a search is explained: its overlap with the nearest CAD silhouette, less
        the doubt that motion raises: where something moves it is not, or what it holds moves with the background."""
        doubt = 0.0
        if motion is not None:
            found = motion.found_share(mask)
            doubt += max(0.0, _MIN_FOUND - found) + _FOUND_BONUS * (1.0 - found)
            doubt += max(0.0, motion.still_share(mask) - _MAX_STILL)
        return self._bank.overlap(mask.astype(bool)) - doubt

    def _required(self, mask: Mask, motion: MotionEvidence | None) -> float:
        """Plausibility that a mask needs: less where motion has its say, more where the border hides a part."""
        required = self._config.min_shape_overlap
        if motion is not None:
            required -= _MOTION_RELIEF
        return required + _CUT_SURCHARGE if sky.touches_border(mask) else required

    def _search(self, frame: Frame, open_sides: tuple[str, ...]) -> _Found | None:
        """Find the target from nothing."""
        whole = self._whole(frame)
        motion = self._motion.evidence()
        cuts = [region.cut_from_nothing(whole.rgb)]
        if motion is not None:
            cuts.append(region.cut_from_motion(whole.rgb, motion.moving))
        cuts += [region.cut_from_nothing(whole.rgb, side, cuts[0]) for side in open_sides]
        # Without motion an open side may let the background in: the first, closed cut is the safest.
        margin = _OPEN_BETTER if motion is None else 0.0
        best, best_score = None, -np.inf
        for cut in cuts:
            if cut is None:
                continue
            contrast, chance = region.edge_contrast(whole.rgb, cut)
            if contrast < max(_MIN_CONTRAST, chance):
                continue
            score = self._plausibility(cut, motion)
            if score >= max(self._required(cut, motion), best_score + margin):
                best, best_score = cut, score
        if best is None:
            return None
        mask = whole.enlarge(best)
        x, y, w, h = cv2.boundingRect(mask)
        margin = _MARGIN_PX + _MARGIN_SHARE * max(w, h)
        window = self._window(frame, (x, y, x + w, y + h), 2.5 * margin)
        if window is None:
            return None
        models = region.ColorModels()
        cut = region.cut_from_seeds(window.rgb, [window.reduce(mask)], margin * window.scale, models)
        if cut is None:
            return None
        contrast, _ = region.edge_contrast(window.rgb, cut)
        return _Found(self._finish(frame, window, cut), best_score, contrast, models)

    def _whole(self, frame: Frame) -> _Window:
        """The whole image, reduced for a search."""
        h, w = frame.rgb.shape[:2]
        scale = min(1.0, self._config.cold_side_px / max(h, w))
        size = (max(1, round(w * scale)), max(1, round(h * scale)))
        return _Window(0, 0, w, h, scale, cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA))

    def _finish(self, frame: Frame, window: _Window, cut: Mask) -> Mask:
        """Outline at full resolution, in a mask of the image's size."""
        part = frame.rgb[window.y0 : window.y0 + window.height, window.x0 : window.x0 + window.width]
        band = max(2, round(1 / window.scale) + 1)
        fine = refine_outline(np.ascontiguousarray(part), window.enlarge(cut), band, _MIN_CONTRAST)
        mask = np.zeros(frame.rgb.shape[:2], np.uint8)
        mask[window.y0 : window.y0 + window.height, window.x0 : window.x0 + window.width] = fine
        return mask

    def _window(self, frame: Frame, box: tuple[int, int, int, int], margin: float) -> _Window | None:
        """The image around a box (x0, y0, x1, y1), reduced to ``work_side_px``; None when hardly any is inside."""
        h, w = frame.rgb.shape[:2]
        m = round(margin)
        x0, y0, x1, y1 = max(0, box[0] - m), max(0, box[1] - m), min(w, box[2] + m), min(h, box[3] + m)
        if x1 - x0 < 8 or y1 - y0 < 8:
            return None
        scale = min(1.0, self._config.work_side_px / max(x1 - x0, y1 - y0))
        size = (max(4, round((x1 - x0) * scale)), max(4, round((y1 - y0) * scale)))
        rgb = cv2.resize(frame.rgb[y0:y1, x0:x1], size, interpolation=cv2.INTER_AREA)
        return _Window(x0, y0, x1 - x0, y1 - y0, scale, rgb)

    def _silhouette(self, frame: Frame, prior: PosePrior | None) -> Mask | None:
        """The predicted silhouette (H, W), None without a prior or when it is out of sight."""
        if prior is None or not np.isfinite(prior.pose_row).all():
            return None
        camera = frame.camera
        scale = min(1.0, 2 * self._config.work_side_px / max(camera.width, camera.height))
        small = camera.crop(0, 0, camera.width, camera.height, scale)
        mask = self._renderer.render(prior.T_cam_target, small, color=False).mask
        if not mask.any():
            return None
        size = (camera.width, camera.height)
        large = cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_LINEAR)
        return (large > 127).astype(np.uint8)


def _shrink(mask: Mask, side_px: int) -> Mask:
    """A 0/1 mask at reduced size, for comparing shapes."""
    scale = min(1.0, side_px / max(mask.shape))
    size = (max(1, round(mask.shape[1] * scale)), max(1, round(mask.shape[0] * scale)))
    return (cv2.resize(mask * 255, size, interpolation=cv2.INTER_AREA) > 127).astype(np.uint8)


def _overlap(a: Mask, b: Mask) -> float:
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 0.0


def _moved(mask: Mask, dx: int, dy: int) -> Mask:
    """A mask moved by whole pixels, what leaves the image dropped."""
    if dx == dy == 0:
        return mask
    out = np.zeros_like(mask)
    h, w = mask.shape
    x0, x1, y0, y1 = max(0, dx), min(w, w + dx), max(0, dy), min(h, h + dy)
    if x1 > x0 and y1 > y0:
        out[y0:y1, x0:x1] = mask[y0 - dy : y1 - dy, x0 - dx : x1 - dx]
    return out


def _explains(silhouette: Mask, lit: Mask, body: Mask) -> bool:
    """Whether what is lit lies inside the predicted silhouette and is spread over it: the rest of it is shadow."""
    inside = np.count_nonzero(silhouette & lit) >= 0.95 * np.count_nonzero(lit)
    return inside and np.count_nonzero(silhouette & body) >= 0.5 * np.count_nonzero(silhouette)


def _shadowed(silhouette: Mask, lit: Mask) -> Mask:
    """The dark parts of a silhouette: what is not lit, without the slivers that a slightly wrong pose leaves."""
    _, _, w, h = cv2.boundingRect(silhouette)
    radius = max(2, round(0.02 * max(w, h)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.morphologyEx(silhouette & (1 - lit), cv2.MORPH_OPEN, kernel)


def _centroid(mask: Mask) -> NDArray[np.float64]:
    x, y, w, h = cv2.boundingRect(mask)
    m = cv2.moments(mask[y : y + h, x : x + w], binaryImage=True)
    return np.array([x + m["m10"] / m["m00"], y + m["m01"] / m["m00"]])


def _touched_sides(mask: Mask) -> tuple[str, ...]:
    touched = (mask[0].any(), mask[-1].any(), mask[:, 0].any(), mask[:, -1].any())
    return tuple(side for side, touches in zip(_SIDES, touched, strict=True) if touches)
