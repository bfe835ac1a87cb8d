"""Evidence of an image for a pose, and its log-likelihood.

Overlap of silhouette and mask comes first. It is expressed as the mean distance between the two outlines in pixels, so
that it means the same for a target of 60 and of 600 pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hat_ros.array_types import Float, Float32
from hat_ros.refinement.mask_field import VISIBLE_LEVEL, MaskField
from hat_ros.refinement.pose_fitter import Fit
from hat_ros.refinement.sunlight import LightField
from hat_ros.refinement.view import TargetViewer, View
from hat_ros.types import Frame

# Outlines closer than this agree, pixels.
_TOLERANCE_PX = 0.5
# A pose whose parts moved less than this against each other is compared as it looked before, pixels.
_SAME_VIEW_PX = 0.5
# Mean distance of outlines at which a mismatch begins to saturate.
_MISMATCH_PX = 0.3
# Share of the mask's surroundings that is black before a black sky.
_DARK_SHARE = 0.7
# Independent samples in a reduced image: residuals err together over parts of the body.
LIGHT_WEIGHT = 18.0
# Light counts up to this far around the mask, and above the sky's noise in grey levels; with a smaller sum in all there
# is no comparison.
_HALO_PX = 9
_SKY_NOISE = 2.0
_MIN_LIGHT = 500.0
_LIGHT_FLOOR = 0.02


@dataclass(frozen=True)
class Evidence:
    """What was measured for one candidate; distances are areas per pixel of outline.

    Attributes:
        overlap: intersection over union with the mask, inside the image.
        excess_px: mask where the pose has no target.
        missing_px: target of the pose where there is no mask but bright background.
        hidden_px: target of the pose where there is no mask, before black.
        mask_rms_px: robust scatter of the outline about the mask's.
        edge_share: share of the outline that coincides with an edge of the image.
        mask_share: share of the outline that coincides with the mask's.
    """

    overlap: float
    excess_px: float
    missing_px: float
    hidden_px: float
    mask_rms_px: float
    edge_share: float
    mask_share: float


class Scorer:
    """Evidence on one frame."""

    def __init__(self, viewer: TargetViewer, frame: Frame, field: MaskField, render_px: int) -> None:
        self._viewer = viewer
        self._frame = frame
        self.field = field
        self.light_field = LightField(frame.rgb, field.mask)
        self._render_px = render_px
        self.luma = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        self.dark_around = self._is_dark_around()

    def _is_dark_around(self) -> bool:
        """Whether the mask is surrounded by black, so that it can only hold what is lit."""
        x0, y0 = np.maximum(self.field.origin_px, 0).astype(int)
        height, width = self.field.distance.shape
        x1, y1 = (self.field.origin_px + (width, height)).astype(int)
        around = self.luma[y0:y1, x0:x1]
        outside = ~self.field.mask[y0:y1, x0:x1]
        n_dark, n_outside = int(np.count_nonzero(outside & (around < VISIBLE_LEVEL))), int(np.count_nonzero(outside))
        return n_dark >= _DARK_SHARE * max(n_outside, 1)

    def light(self) -> Float32 | None:
        """(H, W) light in and around the mask above the sky's level; None when there is hardly any."""
        around = cv2.dilate(self.field.mask.astype(np.uint8), np.ones((_HALO_PX, _HALO_PX), np.uint8))
        outside = self.luma[around == 0]
        level = float(np.median(outside)) if outside.size else 0.0
        light = np.maximum(self.luma.astype(np.float32) - np.float32(level + _SKY_NOISE), 0) * around
        return light if light.sum() >= _MIN_LIGHT else None

    def mismatch(self, view: View, outline_px: float, tolerance_px: float) -> tuple[float, float, float]:
        """Excess, missing and hidden (see :class:`Evidence`) of what disagrees deeper than a tolerance."""
        areas = self.field.compare(view, self.luma, tolerance_px)
        outline = max(outline_px, 1.0)
        return areas.extra / outline, areas.missing / outline, areas.hidden / outline

    def view(self, fit: Fit, to_sun_cam: Float | None = None) -> View | None:
        """What a refined pose looks like, or its part that a sun shines on; None when it cannot be seen."""
        if fit.twist_px <= _SAME_VIEW_PX:
            return fit.view.shifted(fit.shift_px)
        return self._viewer.view(fit.T_cam_target, self._frame.camera, self._render_px, to_sun_cam)

    def evidence(self, fit: Fit, view: View) -> Evidence | None:
        """Gather the evidence for a refined pose that looks like a view; None when it cannot be seen."""
        length = fit.lines[:, 2] * (fit.contour[:, 0] > 0)
        total = fit.outline_px
        if total <= 0:
            return None
        excess, missing, hidden = self.mismatch(view, total, _TOLERANCE_PX + abs(fit.mask_bias_px))
        mask_residual = fit.contour[:, 1] - fit.mask_bias_px
        near = length * fit.contour[:, 2]
        edge = (fit.contour[:, 4] > 0) & (np.abs(fit.contour[:, 3]) < 1.5)
        return Evidence(
            self.field.compare(view, self.luma).union_share,
            excess,
            missing,
            hidden,
            float(np.sqrt((near * mask_residual**2).sum() / max(near.sum(), 1e-9))),
            float(length[edge].sum() / total),
            float(length[np.abs(mask_residual) < 1.5].sum() / total),
        )


def shape_score(excess_px: float, missing_px: float, hidden_px: float) -> float:
    """The part of :func:`log_score` that compares silhouette and mask."""
    return float(
        -6.0 * np.log1p(excess_px / _MISMATCH_PX)
        - 1.7 * np.log1p(missing_px / _MISMATCH_PX)
        - 1.5 * np.log1p(hidden_px / _MISMATCH_PX)
    )


def light_score(distance: float) -> float:
    """Log-likelihood of what is bright and dark, from :class:`hat_ros.refinement.sunlight.Sunlight`.

    That of residuals with a Laplace distribution of unknown width, of as many independent samples as the weight says.
    """
    return float(-LIGHT_WEIGHT * np.log(max(distance, _LIGHT_FLOOR)))


def log_score(e: Evidence) -> float:
    """Log-likelihood of a pose up to a constant common to all candidates of an image.

    The weights are those of a multinomial logistic regression of the right basin on the evidence, over some eight
    hundred images of ten spacecraft whose masks were right, found by thresholds, two pixels too large, or lacked parts;
    on a spacecraft left out of the fit the right basin wins in 97 % of the images (by overlap alone: 84 %). So
    ``selector.score_scale`` 1 leaves them as they are. Logarithms, because masks fail in patches: a large patch is
    hardly more evidence than a small one.
    """
    shape = shape_score(e.excess_px, e.missing_px, e.hidden_px)
    return shape - 5.0 * e.mask_rms_px + 3.3 * e.edge_share + 4.6 * e.mask_share
