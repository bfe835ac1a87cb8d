"""Training-free hypotheses: shape matching against a view bank, then compiled refinement and scoring of each basin.

1. The mask's shape is compared with every view at every in-plane angle (``matching``); the best distinct orientations
   are kept.
2. Each is pulled onto the mask's boundary with the sparse contour of its view, no rendering needed.
3. Each is rendered, compared with the mask, and refined again with its own contour on mask and image edges.
4. The evidence of each is turned into a log-likelihood (``scoring``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hat_ros.config import HatConfig
from hat_ros.errors import ConfigError
from hat_ros.hypotheses.bank import load_or_build
from hat_ros.hypotheses.matching import cut_placements, distinct, match_shape, whole_placement
from hat_ros.hypotheses.scoring import Evidence, evidence, log_scores
from hat_ros.refinement.refiner import Fit, PoseFitter, Schedule
from hat_ros.refinement.view import MaskField, TargetViewer
from hat_ros.target import Target
from hat_ros.types import Candidates, Detection, Frame, PosePrior

_VIEW_COUNTS = (162, 642, 2562)
_CONTOUR_POINTS = 200
# Robust scales as shares of the mask's longer side: how far off a coarse match is, in steps of refinement.
_COARSE_SCALES = (0.10, 0.07, 0.05, 0.04, 0.03, 0.03)
_MIN_SCALE_PX = 1.5
_FIRST = Schedule((0, 0, 0, 0), (1, 1, 1, 1), (6, 4, 3, 2))
_LAST = Schedule((0, 4, 3.5, 3), (1, 2, 1.5, 1.5), (3, 2, 1.5, 1.5))


class TemplateHypotheses:
    """Backend ``template``; see the module's text.

    Args:
        config: the whole configuration.
        target: the CAD model.

    Raises:
        ConfigError: ``n_views`` is no icosphere size or ``n_angles`` is odd.
    """

    def __init__(self, config: HatConfig, target: Target) -> None:
        options = config.hypotheses.template
        if options.n_views not in _VIEW_COUNTS:
            raise ConfigError(f"hypotheses.template.n_views must be one of {_VIEW_COUNTS}, found {options.n_views}")
        if options.n_angles % 2:
            raise ConfigError(f"hypotheses.template.n_angles must be even, found {options.n_angles}")
        self._options = options
        self._max_candidates = config.hypotheses.max_candidates
        self._target = target
        self._viewer = TargetViewer(target)
        self._fitter = PoseFitter(self._viewer, options.render_px, _CONTOUR_POINTS)
        self._bank = load_or_build(target, self._viewer.renderer, options.n_views, options.n_angles)

    def generate(self, frame: Frame, detection: Detection, prior: PosePrior | None) -> Candidates:
        """Up to K refined and scored poses, best first; zero rows when nothing fits."""
        field = MaskField(detection.mask)
        starts = self._coarse(frame, field, detection)
        if prior is not None and prior.healthy:
            starts.insert(0, prior.T_cam_target)
        fits = self._refine(starts, field, frame)
        if not fits:
            return Candidates.none()
        T = np.stack([fit.T_cam_target for fit, _ in fits])
        return Candidates.from_matrices(T, log_scores([e for _, e in fits]), detection.box_xyxy)

    def reset(self) -> None:
        """Nothing to forget: every keyframe stands for itself."""

    def _coarse(self, frame: Frame, field: MaskField, detection: Detection) -> list[NDArray[np.float64]]:
        """Shape matches, pulled onto the mask's boundary."""
        options = self._options
        placements = whole_placement(detection.mask)
        if detection.touches_border():
            placements += cut_placements(detection.mask)
        matches = match_shape(
            self._bank,
            detection.mask,
            placements,
            frame.camera,
            options.n_coarse,
            options.separation_deg,
            self._target.center_m,
        )
        scales = np.maximum(np.array(_COARSE_SCALES) * field.size_px, _MIN_SCALE_PX)
        lines = np.zeros((self._bank.contour_m.shape[1], 5))
        poses = []
        for T, view in zip(matches.T_cam_target, matches.view, strict=True):
            used = self._bank.contour_weight[view] > 0
            lines[:, 2] = self._bank.contour_weight[view]
            poses.append(self._fitter.pull(T, self._bank.contour_m[view][used], lines[used], frame, field, scales))
        return poses

    def _refine(self, starts: list[NDArray[np.float64]], field: MaskField, frame: Frame) -> list[tuple[Fit, Evidence]]:
        """Refine on the mask, keep the K best distinct ones, refine those on the image too, gather their evidence."""
        first = [self._fitter.fit(T, frame.camera, frame.rgb, field, (_FIRST,)) for T in starts]
        first = self._select([fit.T_cam_target for fit in first if fit is not None], field, frame)
        fits = []
        for T in first:
            fit = self._fitter.fit(T, frame.camera, frame.rgb, field, (_LAST,))
            found = None if fit is None else evidence(self._viewer, fit, frame, field, self._options.render_px)
            if found is not None:
                fits.append((fit, found))
        return fits

    def _select(self, poses: list[NDArray[np.float64]], field: MaskField, frame: Frame) -> list[NDArray[np.float64]]:
        """The K poses of best overlap that are distinct basins, best first."""
        kept, overlaps = [], []
        for T in poses:
            view = self._viewer.view(T, frame.camera, self._options.render_px)
            if view is not None:
                common, extra, missing = field.compare(view)
                kept.append(T)
                overlaps.append(common / max(common + extra + missing, 1e-9))
        if not kept:
            return []
        order = np.argsort(-np.array(overlaps), kind="stable")
        T = np.stack(kept)[order]
        return list(T[distinct(T[:, :3, :3], self._max_candidates, np.radians(self._options.separation_deg))])
