"""Segmentation without weights: ``segmentation.backend: classical``.

Before black sky a threshold finds what is lit (:mod:`hat_ros.segmentation.lit`), after stray light has been taken off
(:mod:`hat_ros.segmentation.glow`) and borders without data have been filled (:mod:`hat_ros.segmentation.no_data`).
Before anything else (Earth, clouds, a laboratory) a graph cut separates the target,
seeded by the previous mask and by the silhouette of the predicted pose, or from nothing
(:mod:`hat_ros.segmentation.textured`). What it says is checked against the CAD model's silhouettes and against how the
background moves, and a tracked mask now and then against an independent search, so that a wrong mask does not keep
itself alive.
"""

from __future__ import annotations

import numpy as np

from hat_ros.config import HatConfig
from hat_ros.segmentation.glow import look_into_space
from hat_ros.segmentation.lit import LitBody
from hat_ros.segmentation.masks import Mask, enlarge
from hat_ros.segmentation.no_data import with_sky_in_borders
from hat_ros.segmentation.shape import SilhouetteBank
from hat_ros.segmentation.textured import TexturedBackground
from hat_ros.target.masks import overlap
from hat_ros.target.model import Target
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.types import Detection, Frame, PosePrior

_LEAP = 0.6  # share of the last overlap with a sure silhouette below which a mask is not believed ...
_MAX_LEAPS = 4  # ... for so many frames
_MAX_GROWTH = 1.6  # of what is lit, over the silhouette


class ClassicalSegmenter:
    """See the module's text.

    Args:
        config: the whole configuration.
        target: the CAD model, whose silhouettes tell what a mask can look like.
    """

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._config = config.segmentation.classical
        self._renderer = RayRenderer(target)
        # What is lit is seldom a whole silhouette, and is compared in every frame: there the coarse bank does.
        self._lit = LitBody(self._config, SilhouetteBank(target, self._renderer, n_views=162))
        self._textured = TexturedBackground(self._config, SilhouetteBank(target, self._renderer))
        self.reset()

    def reset(self) -> None:
        """Forget earlier frames."""
        self._textured.reset()
        # Of the frame before the previous one, and of the previous one.
        self._masks: tuple[Mask | None, Mask | None] = (None, None)
        self._filled = 0.0  # overlap of the last mask with a silhouette beyond doubt
        self._n_leaps = 0  # masks in a row that were not believed

    def update(self, frame: Frame, prior: PosePrior | None) -> Detection | None:
        """Find the target in one frame; None rather than a wrong mask."""
        silhouette = self._silhouette(frame, prior)
        supported = prior is not None and prior.supported
        certain = prior is not None and prior.healthy  # what is dark is added only where the basin is beyond doubt
        rgb = with_sky_in_borders(frame.rgb)
        space = look_into_space(rgb, self._config.sky_border_share)
        mask = None
        if space is not None and space.regions:
            mask = self._lit.find(space.sky, space.regions, self._masks[1], silhouette if certain else None)
        lit = mask is not None
        if mask is None and (space is None or space.regions):
            mask = self._textured.find(rgb, self._masks, silhouette, supported)
        if mask is not None and (not mask.any() or (certain and self._leaps(mask, silhouette, lit))):
            mask = None
        self._masks = (self._masks[1], mask)
        return None if mask is None else Detection(mask.astype(bool))

    def _leaps(self, mask: Mask, silhouette: Mask | None, lit: bool) -> bool:
        """Whether a mask suddenly leaves a silhouette beyond doubt that the masks so far have filled.

        The ground comes and goes in a frame, a target does not. What lasts is taken for true after a few frames. What
        is ``lit`` before a black sky has moved, unless it has grown: then it has met something else.
        """
        if silhouette is None:
            return False
        filled = overlap(mask, silhouette)
        moved = lit and np.count_nonzero(mask) <= _MAX_GROWTH * np.count_nonzero(silhouette)
        if not moved and self._n_leaps < _MAX_LEAPS and filled < _LEAP * self._filled:
            self._n_leaps += 1
            return True
        self._filled, self._n_leaps = filled, 0
        return False

    def _silhouette(self, frame: Frame, prior: PosePrior | None) -> Mask | None:
        """The predicted silhouette (H, W), None without a prior or when it is out of sight."""
        if prior is None or not np.isfinite(prior.pose_row).all():
            return None
        x0, y0, x1, y1 = self._renderer.pixel_bounds(prior.T_cam_target, frame.camera)
        if x0 >= x1 or y0 >= y1:
            return None
        # Rendered about as fine as the region model works.
        step = max(1, round(max(x1 - x0, y1 - y0) / self._config.work_side_px))
        width, height = -(-(x1 - x0) // step) * step, -(-(y1 - y0) // step) * step
        crop = frame.camera.crop(x0, y0, width, height, 1 / step)
        part = self._renderer.quick_silhouette(prior.T_cam_target, crop)
        if not part.any():
            return None
        mask = np.zeros(frame.rgb.shape[:2], np.uint8)
        mask[y0:y1, x0:x1] = enlarge(part.view(np.uint8), (width, height))[: y1 - y0, : x1 - x0]
        return mask
