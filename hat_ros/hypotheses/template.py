"""Training-free hypotheses: matching against banks of views, then compiled refinement and scoring of each basin.

1. The mask's shape is compared with every view at every in-plane angle (``matching``); the best distinct orientations
   are kept.
2. Each is pulled onto the mask's boundary with the sparse contour of its view, no rendering needed; the third that
   lies on it best is kept.
3. Each is rendered, compared with the mask, and refined again with its own contour on mask and image edges.
4. The evidence of each is turned into a log-likelihood (``scoring``): how well its outline and the mask's agree, and
   how well it explains what is bright and what is dark (``refinement.sunlight``).

A pose predicted from the past is one more start, whatever its health: where the image is ambiguous, a track without a
candidate of its own would lose to chance.

Unless the best candidate is where a healthy track expects it, more is tried. A mask that no view fits well is matched
as part of a silhouette, unless shading decides and there is a prior. Before a black sky the mask holds what is
lit, which need not be the whole target: matches of brightness (``lit_bank``) compete as well, and of those only the
sunlit part of the contour is compared with the mask. Stray light around the mask is taken off before, where the sky is
black otherwise. Before anything else more shape matches are tried where no candidate leads clearly. At last the best
candidate competes with the orientations that have nearly its silhouette (``symmetry``), tried or not, and before
anything but a black sky these are compared once more by their details.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from hat_ros.array_types import Bool, Float
from hat_ros.config import HatConfig
from hat_ros.errors import ConfigError
from hat_ros.geometry import lie
from hat_ros.hypotheses.box import silhouette_in_box
from hat_ros.hypotheses.lit_bank import load_or_build_lit
from hat_ros.hypotheses.matching import (
    Placement,
    ShapeMatches,
    cut_placements,
    distinct,
    match_light,
    match_shape,
    partial_placements,
    warm_up,
    whole_placement,
)
from hat_ros.hypotheses.scoring import Scorer, light_score, log_score, shape_score
from hat_ros.refinement.mask_field import MaskField
from hat_ros.refinement.pose_fitter import PoseFitter, Schedule
from hat_ros.refinement.sunlight import SunMatcher
from hat_ros.refinement.view import TargetViewer
from hat_ros.segmentation.glow import look_into_space
from hat_ros.target.model import Target
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.symmetry import load_or_find_symmetries, turned
from hat_ros.target.view_bank import ViewBank, load_or_build, without_thin_parts
from hat_ros.types import Camera, Candidates, Detection, Frame, PosePrior

_VIEW_COUNTS = (162, 642, 2562)
_CONTOUR_POINTS = 200
# Robust scales as shares of the mask's longer side: how far off a coarse match is, in steps of refinement.
_COARSE_SCALES = (0.10, 0.07, 0.05, 0.04, 0.03, 0.03)
_MIN_SCALE_PX = 1.5
# Share of the coarse matches that are refined: those whose contour lies nearest to the mask's. A point further from it
# than this share of the mask's longer side may belong to a part that the mask lacks, and counts as that far.
_REFINED_SHARE = 1 / 3
_FAR_SHARE = 0.1
# Without a prior the search is global: so many times as many coarse matches are refined (six times found
# no more right poses than three on clips with poor masks, and more wrong ones).
_UNAIDED_FACTOR = 3
# Before the mask's bias is known, outlines this close agree.
_SELECTION_TOLERANCE_PX = 1.0
# Best shape score below which the mask is taken to be incomplete.
_POOR_SCORE = -6.0
# So far behind the best score, shading cannot make up for it.
_LIGHT_MATTERS = 14.0
# With a healthy prior among the starts, fewer matches: enough to detect a competing basin.
_TRACKED_DIVISOR = 2
# Where shading decides, so many times fewer shape matches compete: on six dark clips no right one was below.
_LIT_DIVISOR = 2
# A lead in log-likelihood that ends the search; without one, so many times the usual shape matches are tried.
_CLEAR_LEAD = 6.0
_MORE_COARSE = 3
# Candidates of different searches closer than this are the same.
_SAME_DEG = 8.0
# One this close to a pose has ended where a start at that pose would end.
_TRIED_DEG = 2.0
# Orientations of nearly one silhouette are told apart by details: rendered so many times finer.
_FINER = 3
_FIRST = Schedule((0, 0, 0, 0), (1, 1, 1, 1), (6, 4, 3, 2))
_LAST = Schedule((0, 4, 3.5, 3), (1, 2, 1.5, 1.5), (3, 2, 1.5, 1.5))


@dataclass(frozen=True, eq=False)
class Aligned:
    """A start after the first refinement.

    Attributes:
        T_cam_target: (4, 4) pose.
        to_sun_cam: direction to the sun (3,) if the mask is only what is lit.
        score: its shape score.
    """

    T_cam_target: Float
    to_sun_cam: Float | None
    score: float


@dataclass(frozen=True, eq=False)
class Compared:
    """Views, and the mask (H, W) bool that they are compared with: both with their thin parts, or both without."""

    bank: ViewBank
    mask: Bool


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
        self._sky_border_share = config.segmentation.classical.sky_border_share
        self._target = target
        self._viewer = TargetViewer(target)
        self._fitter = PoseFitter(self._viewer, options.render_px, _CONTOUR_POINTS)
        self._finer_fitter = PoseFitter(self._viewer, _FINER * options.render_px, _CONTOUR_POINTS)
        self._sun = SunMatcher(self._viewer)
        self._lit_bank = load_or_build_lit(self._viewer, options.n_angles)
        renderer = RayRenderer(target)
        self._bank = load_or_build(target, renderer, options.n_views, options.n_angles)
        self._body_bank = load_or_build(target, renderer, options.n_views, options.n_angles, thin_parts=False)
        self._near_symmetries = load_or_find_symmetries(target)
        for bank in (self._lit_bank, self._bank, self._body_bank):  # a bank just built is not typed like one from disk
            warm_up(bank)

    def generate(self, frame: Frame, detection: Detection, prior: PosePrior | None) -> Candidates:
        """Up to K refined and scored poses, best first; zero rows when nothing fits."""
        mask = detection.mask if detection.silhouette else silhouette_in_box(frame.rgb, detection.mask)
        if mask is None:
            return Candidates.none()
        field = MaskField(mask)
        scorer = Scorer(self._viewer, frame, field, self._options.render_px)
        if not scorer.dark_around:
            space = look_into_space(frame.rgb, self._sky_border_share)
            if space is not None and space.rgb is not frame.rgb:  # light of other origin is no evidence
                frame = replace(frame, rgb=space.rgb)
                scorer = Scorer(self._viewer, frame, field, self._options.render_px)
        starts = []
        n_coarse = n_usual = self._options.n_coarse * (_UNAIDED_FACTOR if prior is None else 1)
        if prior is not None:
            starts.append(self._fitter.centred(prior.T_cam_target, frame.camera, field, scorer.luma))
            if prior.healthy:
                n_coarse = max(1, n_coarse // _TRACKED_DIVISOR)
        compared = Compared(self._bank, mask)
        if not scorer.dark_around:  # thin parts show before a black sky only
            compared = Compared(self._body_bank, without_thin_parts(mask))
        placements = whole_placement(compared.mask)
        aligned = self._align(starts + self._coarse(compared, placements, frame, field, n_coarse), frame, scorer)
        best = max(aligned, key=lambda a: a.score, default=None)
        # Shading finds poses whose shadowed parts the mask lacks; without a prior both searches run.
        relies_on_light = scorer.dark_around and prior is not None
        explained = best is not None and (best.score >= _POOR_SCORE or self._confirms(best.T_cam_target, prior))
        if best is None or not (explained or relies_on_light):
            # The mask is not the whole silhouette: look for those that it may be a part of.
            cut = detection.touches_border()
            placements = cut_placements(compared.mask) if cut else partial_placements(compared.mask)
            n_coarse = n_usual
            aligned += self._align(self._coarse(compared, placements, frame, field, n_coarse), frame, scorer)
        selected = self._select(aligned, self._max_candidates)
        promising = selected[: self._max_candidates // _LIT_DIVISOR] if relies_on_light else selected
        scored = self._finish(promising, frame, scorer)
        leader = max(scored, key=lambda pair: pair[1], default=None)
        if scorer.dark_around and (leader is None or not self._confirms(leader[0], prior)):
            # What lies in shadow is missing from the mask: compare what is bright.
            lit = self._align(starts + self._coarse_lit(frame, scorer), frame, scorer, in_sunlight=True)
            scored += self._finish(lit, frame, scorer)
        else:
            scored += self._finish(selected[len(promising) :], frame, scorer)
            if not self._is_clear(scored, prior):
                further = self._coarse(compared, placements, frame, field, _MORE_COARSE * n_usual, n_coarse)
                aligned += self._align(further, frame, scorer)
                more = self._select(aligned, 2 * self._max_candidates)
                scored += self._finish([start for start in more if start not in selected], frame, scorer)
        if not scored:
            return Candidates.none()
        if len(self._near_symmetries):
            scored += self._finish(self._align(self._counterparts(scored), frame, scorer), frame, scorer)
            if not scorer.dark_around:
                scored = self._compare_details(scored, frame, scorer)
        scored.sort(key=lambda pair: -pair[1])
        T, score = np.stack([T for T, _ in scored]), np.array([score for _, score in scored])
        keep = distinct(T[:, :3, :3], self._max_candidates, np.radians(_SAME_DEG))
        return Candidates.from_matrices(T[keep], score[keep], detection.box_xyxy)

    def reset(self) -> None:
        """Nothing is kept between keyframes."""

    def _coarse(
        self,
        compared: Compared,
        placements: list[Placement],
        frame: Frame,
        field: MaskField,
        n_coarse: int,
        n_known: int = 0,
    ) -> list[Float]:
        """The best shape matches after those that are known already, pulled onto the mask's boundary."""
        options = self._options
        matches = match_shape(
            compared.bank,
            compared.mask,
            placements,
            frame.camera,
            n_coarse,
            options.separation_deg,
            self._target.center_m,
        )
        further = ShapeMatches(matches.T_cam_target[n_known:], matches.view[n_known:], matches.score[n_known:])
        return self._pulled(compared.bank, further, frame, field)

    def _coarse_lit(self, frame: Frame, scorer: Scorer) -> list[Float]:
        """The best matches of brightness."""
        light, options = scorer.light(), self._options
        if light is None:
            return []
        matches = match_light(
            self._lit_bank, light, frame.camera, options.n_coarse_lit, options.separation_deg, self._target.center_m
        )
        return list(matches.T_cam_target)

    def _pulled(self, bank: ViewBank, matches: ShapeMatches, frame: Frame, field: MaskField) -> list[Float]:
        """Matches pulled onto the mask's boundary with the contour of their views: those that lie on it best."""
        scales = np.maximum(np.array(_COARSE_SCALES) * field.size_px, _MIN_SCALE_PX)
        lines = np.zeros((bank.contour_m.shape[1], 5))
        pulled, distance_px = [], []
        for T_coarse, view in zip(matches.T_cam_target, matches.view, strict=True):
            used = bank.contour_weight[view] > 0
            lines[:, 2] = bank.contour_weight[view]
            points_m = bank.contour_m[view][used]
            T = self._fitter.pull(T_coarse, points_m, lines[used], frame, field, scales)
            pulled.append(T)
            distance_px.append(_outline_distance_px(T, points_m, frame.camera, field))
        n_kept = max(1, int(np.ceil(_REFINED_SHARE * len(pulled))))
        return [pulled[i] for i in np.argsort(distance_px, kind="stable")[:n_kept]]

    def _align(self, starts: list[Float], frame: Frame, scorer: Scorer, in_sunlight: bool = False) -> list[Aligned]:
        """Refine on the mask with rendered contours, or with what of them is sunlit, and compare shapes."""
        out = []
        for T in starts:
            view, to_sun = self._viewer.view(T, frame.camera, self._options.render_px), None
            if view is not None and in_sunlight:
                sunlight = self._sun.match(view, scorer.light_field)
                to_sun = None if sunlight is None else sunlight.to_sun_cam
                view = None if to_sun is None else self._viewer.in_sunlight(view, to_sun)
            if view is None:
                continue
            fit = self._fitter.iterate(T, view, frame.camera, frame.rgb, scorer.field, _FIRST)
            score = shape_score(*scorer.mismatch(view, fit.outline_px, _SELECTION_TOLERANCE_PX))
            out.append(Aligned(fit.T_cam_target, to_sun, score))
        return out

    def _select(self, aligned: list[Aligned], n_best: int) -> list[Aligned]:
        """Those of best shape that are distinct basins, best first."""
        if not aligned:
            return []
        ordered = sorted(aligned, key=lambda a: -a.score)
        R = np.stack([a.T_cam_target[:3, :3] for a in ordered])
        return [ordered[i] for i in distinct(R, n_best, np.radians(self._options.separation_deg))]

    def _counterparts(self, scored: list[tuple[Float, float]]) -> list[Float]:
        """Poses that look like the best candidate and have not been tried: no other start may have been near them."""
        known = np.stack([T[:3, :3] for T, _ in scored])
        _, *others = self._alike(scored)
        return [T for T in others if lie.angle_between(known, T[:3, :3]).min() > np.radians(_TRIED_DEG)]

    def _alike(self, scored: list[tuple[Float, float]]) -> list[Float]:
        """The best candidate, and the poses that have nearly its silhouette: (4, 4) each."""
        leader, _ = max(scored, key=lambda pair: pair[1])
        return [leader, *(turned(leader, turn, self._target.center_m) for turn in self._near_symmetries)]

    def _compare_details(
        self, scored: list[tuple[Float, float]], frame: Frame, scorer: Scorer
    ) -> list[tuple[Float, float]]:
        """The same; the best candidate and those of nearly its silhouette are compared again at a finer resolution."""
        basin = np.stack([T[:3, :3] for T in self._alike(scored)])
        rest: list[tuple[Float, float]] = []
        best: dict[int, tuple[Float, float]] = {}
        for T, score in scored:
            apart_rad = lie.angle_between(basin, T[:3, :3])
            nearest = int(np.argmin(apart_rad))
            if apart_rad[nearest] > np.radians(_SAME_DEG):
                rest.append((T, score))
            elif nearest not in best or score > best[nearest][1]:
                best[nearest] = (T, score)
        starts = [Aligned(T, None, score) for T, score in best.values()]
        finer = Scorer(self._viewer, frame, scorer.field, _FINER * self._options.render_px)
        again = self._finish(starts, frame, finer, self._finer_fitter)
        return rest + again if len(again) == len(starts) else scored

    def _confirms(self, T_cam_target: Float, prior: PosePrior | None) -> bool:
        """Whether a candidate lies in the basin of a healthy prior: then the search ends."""
        if prior is None or not prior.healthy:
            return False
        apart_rad = lie.angle_between(T_cam_target[:3, :3], prior.T_cam_target[:3, :3])
        return bool(apart_rad < np.radians(self._options.separation_deg))

    def _is_clear(self, scored: list[tuple[Float, float]], prior: PosePrior | None) -> bool:
        """Whether a candidate leads all other basins clearly, or leads in the basin of a healthy prior."""
        if not scored:
            return False
        leader, best = max(scored, key=lambda pair: pair[1])
        apart_rad = lie.angle_between(np.stack([T[:3, :3] for T, _ in scored]), leader[:3, :3])
        competing = np.array([score for _, score in scored])[apart_rad > np.radians(self._options.separation_deg)]
        return bool(best - competing.max(initial=-np.inf) >= _CLEAR_LEAD) or self._confirms(leader, prior)

    def _finish(
        self, starts: list[Aligned], frame: Frame, scorer: Scorer, fitter: PoseFitter | None = None
    ) -> list[tuple[Float, float]]:
        """Refine on mask and image, and score: poses and log-likelihoods.

        Sunlight is fitted to those that it could still make the best; the others are given the worst of these fits.
        """
        fitter = fitter or self._fitter
        poses, views, scores = [], [], []
        for start in starts:
            fit = fitter.fit(
                start.T_cam_target, frame.camera, frame.rgb, scorer.field, (_LAST,), to_sun_cam=start.to_sun_cam
            )
            view = None if fit is None else scorer.view(fit, start.to_sun_cam)
            if fit is None or view is None:
                continue
            evidence = scorer.evidence(fit, view)
            if evidence is not None:
                poses.append(fit.T_cam_target)
                views.append(view)
                scores.append(log_score(evidence))
        light = np.full(len(poses), np.nan)
        for i, view in enumerate(views):
            if scores[i] > max(scores) - _LIGHT_MATTERS:
                sunlight = self._sun.match(view, scorer.light_field)
                light[i] = light_score(1.0 if sunlight is None else sunlight.distance)
        worst = np.nanmin(light) if len(poses) else 0.0
        light = np.nan_to_num(light, nan=worst)
        return [(T, score + float(extra)) for T, score, extra in zip(poses, scores, light, strict=True)]


def _outline_distance_px(T_cam_target: Float, points_m: Float, camera: Camera, field: MaskField) -> float:
    """Mean distance of contour points (N, 3) from a mask's outline, pixels; far ones are clipped."""
    uv = camera.project(points_m @ T_cam_target[:3, :3].T + T_cam_target[:3, 3]) - field.origin_px
    u, v = (np.ascontiguousarray(uv[None, :, axis], np.float32) for axis in range(2))
    distance = cv2.remap(field.distance, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return float(np.minimum(np.abs(distance), _FAR_SHARE * field.size_px).mean())
