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
from hat_ros.hypotheses.box import silhouette_in_box
from hat_ros.hypotheses.matching import (
    Placement,
    cut_placements,
    distinct,
    match_shape,
    partial_placements,
    whole_placement,
)
from hat_ros.hypotheses.scoring import Evidence, Scorer, log_score, shape_score
from hat_ros.refinement.refiner import Fit, PoseFitter, Schedule
from hat_ros.refinement.view import MaskField, TargetViewer
from hat_ros.render import create_renderer
from hat_ros.target import Target
from hat_ros.types import Candidates, Detection, Frame, PosePrior

_VIEW_COUNTS = (162, 642, 2562)
_CONTOUR_POINTS = 200
# Robust scales as shares of the mask's longer side: how far off a coarse match is, in steps of refinement.
_COARSE_SCALES = (0.10, 0.07, 0.05, 0.04, 0.03, 0.03)
_MIN_SCALE_PX = 1.5
# Before the mask's bias is known, outlines this close agree.
_SELECTION_TOLERANCE_PX = 1.0
# Best shape score below which the mask is taken to be incomplete.
_POOR_SCORE = -6.0
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
        self._bank = load_or_build(target, create_renderer("embree", target), options.n_views, options.n_angles)

    def generate(self, frame: Frame, detection: Detection, prior: PosePrior | None) -> Candidates:
        """Up to K refined and scored poses, best first; zero rows when nothing fits."""
        mask = detection.mask if detection.silhouette else silhouette_in_box(frame.rgb, detection.mask)
        if mask is None:
            return Candidates.none()
        field = MaskField(mask)
        scorer = Scorer(self._viewer, frame, field, self._options.render_px)
        starts = []
        if prior is not None and prior.healthy:
            starts.append(self._fitter.centred(prior.T_cam_target, frame.camera, field, scorer.luma))
        poses, scores = self._align(starts + self._coarse(whole_placement(mask), frame, field), frame, scorer)
        if not poses or max(scores) < _POOR_SCORE:
            # The mask is not the whole silhouette: look for those that it may be a part of.
            cut = detection.touches_border()
            placements = cut_placements(mask) if cut else partial_placements(mask)
            more_poses, more_scores = self._align(self._coarse(placements, frame, field), frame, scorer)
            poses, scores = poses + more_poses, scores + more_scores
        fits = self._finish(self._select(poses, scores), frame, scorer)
        if not fits:
            return Candidates.none()
        T = np.stack([fit.T_cam_target for fit, _ in fits])
        return Candidates.from_matrices(T, np.array([log_score(e) for _, e in fits]), detection.box_xyxy)

    def reset(self) -> None:
        """Nothing to forget: every keyframe stands for itself."""

    def _coarse(self, placements: list[Placement], frame: Frame, field: MaskField) -> list[NDArray[np.float64]]:
        """Shape matches, pulled onto the mask's boundary."""
        options = self._options
        matches = match_shape(
            self._bank,
            field.mask,
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

    def _align(
        self, starts: list[NDArray[np.float64]], frame: Frame, scorer: Scorer
    ) -> tuple[list[NDArray[np.float64]], list[float]]:
        """Refine on the mask with rendered contours: poses and their shape scores."""
        poses, scores = [], []
        for T in starts:
            view = self._viewer.view(T, frame.camera, self._options.render_px)
            if view is None:
                continue
            fit = self._fitter.iterate(T, view, frame.camera, frame.rgb, scorer.field, _FIRST)
            poses.append(fit.T_cam_target)
            scores.append(shape_score(*scorer.mismatch(view, fit.outline_px, _SELECTION_TOLERANCE_PX)))
        return poses, scores

    def _select(self, poses: list[NDArray[np.float64]], scores: list[float]) -> list[NDArray[np.float64]]:
        """The K poses of best shape that are distinct basins, best first."""
        if not poses:
            return []
        T = np.stack(poses)[np.argsort(-np.array(scores), kind="stable")]
        return list(T[distinct(T[:, :3, :3], self._max_candidates, np.radians(self._options.separation_deg))])

    def _finish(self, poses: list[NDArray[np.float64]], frame: Frame, scorer: Scorer) -> list[tuple[Fit, Evidence]]:
        """Refine on mask and image, and gather the evidence."""
        out = []
        for T in poses:
            fit = self._fitter.fit(T, frame.camera, frame.rgb, scorer.field, (_LAST,))
            evidence = None if fit is None else scorer.evidence(fit)
            if fit is not None and evidence is not None:
                out.append((fit, evidence))
        return out
