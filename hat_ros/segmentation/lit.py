"""Which of the bright regions before a black sky is the target, and what of it lies in shadow."""

from __future__ import annotations

import cv2
import numpy as np

from hat_ros.config import ClassicalConfig
from hat_ros.segmentation import sky
from hat_ros.segmentation.dim import with_dim_parts
from hat_ros.segmentation.masks import Mask, border_contact, enlarge, shrink, touches_border
from hat_ros.segmentation.search import CUT_SURCHARGE
from hat_ros.segmentation.shape import SilhouetteBank

# A second bright region with this share of the largest makes the choice a question; less where the border cuts the
# largest, which may then be a planet.
_COMPETING_SHARE = 0.2
_COMPETING_SHARE_CUT = 0.03
_SAME_SHARE = 0.6  # of a region lies where the target was
_MAX_GROWTH = 1.6  # of the target's area from one frame to the next
_MIN_LIT_SHAPE = 0.5  # shape overlap of the lit part of a target
_MAX_CONTACT = 0.4  # share of its outline that the image border may cut off a target
# With less than this share of a body lit, the gaps between its parts may be shadow; with less than the other, what is
# lit has no shape of its own.
_SCATTERED_SHARE = 0.65
_SHAPELESS_SHARE = 0.35
_SCATTERED_GAIN = 0.1  # shape overlap that bridging the gaps between lit parts must bring


class LitBody:
    """Finds the target before a black sky."""

    def __init__(self, config: ClassicalConfig, bank: SilhouetteBank) -> None:
        self._config = config
        self._bank = bank

    def find(self, measured: sky.Sky, regions: list[Mask], before: Mask | None, silhouette: Mask | None) -> Mask | None:
        """The target's mask.

        Args:
            measured: the image and its sky.
            regions: what is lit in it, see :func:`hat_ros.segmentation.sky.lit_regions`; at least one.
            before: mask of the previous frame, None without one.
            silhouette: trusted prediction, None without one; what it says is dark is added.

        Returns:
            (H, W) uint8 of 0 and 1; None when none of what is lit can be told to be the target.
        """
        sizes = [np.count_nonzero(r) for r in regions]
        cut = touches_border(regions[0])
        competing = [
            i for i, size in enumerate(sizes) if size >= (_COMPETING_SHARE_CUT if cut else _COMPETING_SHARE) * sizes[0]
        ]
        main = self._choose(regions, competing, before, silhouette) if cut or len(competing) > 1 else 0
        if main is None:
            return None
        bright = sky.join_parts(regions, main)
        lit = with_dim_parts(measured, bright)
        body = self._complete(lit, sky.lit_share(bright))
        if silhouette is not None and _explains(silhouette, lit, body):
            return lit | _shadowed(silhouette, lit)
        return body

    def _choose(
        self, regions: list[Mask], competing: list[int], before: Mask | None, silhouette: Mask | None
    ) -> int | None:
        """Which bright region is the target: the one that is where it was, or else the one with its shape.

        A planet, too, is a bright region, always cut by the image border; so one that the border does not cut is
        preferred, and a cut one must not be mostly border. None when no region will do.
        """
        for known in (before, silhouette):
            if known is not None:
                shared = {i: np.count_nonzero(regions[i] & known) for i in competing}
                most = max(competing, key=lambda i: shared[i])
                size = np.count_nonzero(regions[most])
                if shared[most] >= _SAME_SHARE * size and size <= _MAX_GROWTH * np.count_nonzero(known):
                    return most
        shape = {i: self._bank.overlap(shrink(regions[i], self._config.cold_side_px).astype(bool)) for i in competing}
        whole = [i for i in competing if not touches_border(regions[i])]
        best = max(whole, key=lambda i: shape[i], default=None)
        if best is not None and (shape[best] >= _MIN_LIT_SHAPE or len(whole) == len(competing)):
            return best
        required = self._config.min_shape_overlap + CUT_SURCHARGE
        cut = [i for i in competing if shape[i] >= required and border_contact(regions[i]) <= _MAX_CONTACT]
        return max((i for i in cut if i not in whole), key=lambda i: shape[i], default=best)

    def _complete(self, lit: Mask, lit_share: float) -> Mask:
        """The body of which ``lit`` are the lit parts: ``lit`` itself, or with its gaps bridged.

        Bridging shows a body in shadow, but fills the sky between wings and hull as well. So what it makes must be
        a shape that the CAD model can have, unless what is lit has none at all.
        """
        if lit_share >= _SCATTERED_SHARE:
            return lit
        box, options = sky.bridge_gaps(lit, self._config.work_side_px)
        shapes = [self._bank.overlap(option) for option in options]
        best = int(np.argmax(shapes))
        required = shapes[0] + _SCATTERED_GAIN
        if lit_share >= _SHAPELESS_SHARE:
            required = max(required, self._config.min_shape_overlap)
        if shapes[best] < required:
            return lit
        body = lit.copy()
        body[box] |= enlarge(options[best].astype(np.uint8), (body[box].shape[1], body[box].shape[0]))
        return body


def _explains(silhouette: Mask, lit: Mask, body: Mask) -> bool:
    """Whether what is lit lies inside the predicted silhouette and is spread over it: the rest of it is shadow."""
    inside = np.count_nonzero(silhouette & lit) >= 0.95 * np.count_nonzero(lit)
    return bool(inside and np.count_nonzero(silhouette & body) >= 0.5 * np.count_nonzero(silhouette))


def _shadowed(silhouette: Mask, lit: Mask) -> Mask:
    """The dark parts of a silhouette: what is not lit, without the slivers that a slightly wrong pose leaves."""
    x, y, w, h = cv2.boundingRect(silhouette)
    radius = max(2, round(0.02 * max(w, h)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    box = np.s_[max(0, y - radius) : y + h + radius, max(0, x - radius) : x + w + radius]
    out = np.zeros_like(silhouette)
    out[box] = cv2.morphologyEx(silhouette[box] & (1 - lit[box]), cv2.MORPH_OPEN, kernel)
    return out
