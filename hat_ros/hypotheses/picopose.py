"""PicoPose as a hypothesis backend: five templates, affine, correspondences, PnP (paper, Pico-HAT).

One keyframe costs one transformer pass, one batched decoder pass for the K retrieved templates and K PnP problems; the
templates' features are computed once per CAD model and checkpoint and memory-mapped from the cache folder.
"""

from __future__ import annotations

import hashlib
import logging
from functools import partial

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hat_ros.array_types import Float, Float32, Int
from hat_ros.cache import cached_arrays, discard
from hat_ros.config import HatConfig, PicoPoseConfig
from hat_ros.geometry import lie
from hat_ros.hypotheses.picopose_templates import (
    CROP_PX,
    POINT_CELLS,
    TEMPLATE_K,
    Templates,
    render_templates,
    square_crop,
)
from hat_ros.nets import picopose as pp
from hat_ros.nets.checkpoint import load_into, load_state
from hat_ros.nets.runtime import Runtime
from hat_ros.target.model import Target
from hat_ros.types import Candidates, Detection, Frame, PosePrior

LOG = logging.getLogger(__name__)

_FORMAT = 2
_MIN_CORRESPONDENCES = 4


class PicoPoseHypotheses:
    """Stage 2 backend ``picopose``; see the module's text.

    Raises:
        WeightsError: the checkpoint is missing or does not fit.
    """

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._settings = config.hypotheses.picopose
        self._n_candidates = config.hypotheses.max_candidates
        self._runtime = Runtime(config.nets, "picopose")
        state = load_state("picopose", config.nets.weights_folder, config.nets.allow_unverified)
        self._net = pp.PicoPoseNet()
        load_into(self._net, state, "picopose")
        self._runtime.place(self._net)
        self._extract = self._runtime.wrap(self._net.feature_extractor)
        weights = fingerprint(state)
        del state  # gigabytes that would lie beside the network while templates are encoded
        self._load_templates(target, weights)

    def _load_templates(self, target: Target, weights: str) -> None:
        key = f"{_FORMAT}:{target.sha256}:{weights}"
        parts: list[str] = []
        arrays = cached_arrays("picopose", key, lambda: self._build(target, key, parts))
        for part in parts:  # the whole is stored now
            discard("picopose_part", part)
        tensor = self._runtime.tensor
        self._lower_levels = [arrays[f"features{i}"] for i in range(len(pp.FEATURE_BLOCKS) - 1)]
        self._matching = tensor(arrays["features3"])
        self._masks, self._M, self._T = tensor(arrays["masks"]), tensor(arrays["M"]), tensor(arrays["T_cam_target"])
        self._points_m = np.array(arrays["points_m"])

    def _build(self, target: Target, key: str, parts: list[str]) -> dict[str, NDArray]:
        """Encode all templates, batch by batch into the cache, so that a run that is stopped keeps what it has done."""
        templates: Templates = render_templates(target)
        levels: list[list[NDArray]] = [[] for _ in pp.FEATURE_BLOCKS]
        for batch in self._runtime.batches(len(templates.crops), self._settings.batch_size):
            parts.append(f"{key}:{batch.start}:{batch.stop}")
            part = cached_arrays("picopose_part", parts[-1], partial(self._encode, templates.crops[batch]))
            for i, level in enumerate(levels):
                level.append(part[f"features{i}"])
            LOG.info("encoded %d of %d templates, once per CAD model and checkpoint", batch.stop, len(templates.crops))
        out = {f"features{i}": np.concatenate(level) for i, level in enumerate(levels)}
        masks = pp.patch_mask(torch.from_numpy(templates.masks)).numpy()
        return (
            out
            | {"masks": masks, "M": templates.M, "T_cam_target": templates.T_cam_target}
            | {"points_m": templates.points_m}
        )

    @torch.inference_mode()
    def _encode(self, crops: NDArray) -> dict[str, NDArray]:
        """Features of (N, 3, H, W) template crops, by level."""
        features = self._extract(pp.normalise_crops(self._runtime.tensor(crops)))
        return {f"features{i}": level.float().cpu().numpy() for i, level in enumerate(features)}

    @torch.inference_mode()
    def generate(self, frame: Frame, detection: Detection, prior: PosePrior | None) -> Candidates:
        """K poses scored by their share of PnP inliers; the prior is not used (published behaviour)."""
        tensor = self._runtime.tensor
        crop = square_crop(detection.mask)
        features = self._extract(pp.normalise_crops(tensor(crop.resize(frame.rgb))[None]))
        mask = pp.patch_mask(tensor(crop.resize_mask(detection.mask))[None])[0]
        scores = pp.match_templates(features[-1][0], mask, self._matching)
        best = scores.topk(min(self._n_candidates, len(scores))).indices
        affine = self._affine(features, best)
        K, M_image, K_template = tensor(frame.camera.K), tensor(crop.M), tensor(TEMPLATE_K)
        fallback = pp.affine_pose(affine, M_image, K, self._T[best], self._M[best], K_template)
        matches = self._correspond(features, best, affine)
        T, score = fallback.double().cpu().numpy(), np.zeros(len(best))
        for i, (source, at) in enumerate(matches):
            solved = solve_pose(source, at, self._points_m[int(best[i])], crop.M, frame.camera.K, self._settings)
            if solved is not None:
                T[i], score[i] = solved
        rigid = lie.is_rigid(T)  # an affine of no size has no pose to fall back on
        return Candidates.from_matrices(T[rigid], score[rigid], detection.box_xyxy)

    def reset(self) -> None:
        """Nothing is learned from earlier frames."""

    def _affine(self, features: list[Tensor], best: Tensor) -> Tensor:
        similarity = pp.similarity_volume(features[-1][0], self._matching[best], self._masks[best])
        translation, scale, inplane = self._net.affine_regressor(similarity)
        t = self._T[best, :3, 3]
        centre = (self._runtime.tensor(TEMPLATE_K) @ t[:, :, None])[..., 0]
        centre = (self._M[best] @ (centre / centre[:, 2:])[:, :, None])[:, :2, 0]
        return pp.affine_matrix(translation, scale, inplane, centre)

    def _correspond(self, features: list[Tensor], best: Tensor, affine: Tensor) -> list[tuple[NDArray, NDArray]]:
        """Per hypothesis: template cells (M, 2) and image cells (M, 2), x y at 64 x 64."""
        chosen = best.cpu().numpy()
        templates = [self._runtime.tensor(level[chosen]) for level in self._lower_levels] + [self._matching[best]]
        head = self._net.offset_regressor.dpt_head
        image = [x.expand(len(best), -1, -1, -1) for x in head(features)]
        masks = self._masks[best]
        levels = self._net.offset_regressor.flow_decoder(
            head(templates), image, pp.initial_flow(affine, masks), masks[:, None]
        )
        flow, certainty = levels[-1]
        pairs = [pp.correspondences(flow[i], certainty[i]) for i in range(len(best))]
        return [(source.cpu().numpy(), at.cpu().numpy()) for source, at in pairs]


def solve_pose(
    source: Int,
    at: Int,
    points_m: Float32,
    M_image: Float,
    K: Float,
    settings: PicoPoseConfig,
) -> tuple[Float, float] | None:
    """EPnP-RANSAC over correspondences: (4, 4) pose and inlier share, or None when there is no pose.

    Args:
        source: (M, 2) template cells x y. at: (M, 2) image cells x y. points_m: (64, 64, 3) target points of the
            template's cells, NaN off the target. M_image: (3, 3) image to crop. K: (3, 3) intrinsics.
        settings: thresholds.
    """
    points = points_m[source[:, 1], source[:, 0]].astype(np.float64)
    crop_px = (at + 0.5) * (CROP_PX / POINT_CELLS)
    image_px = (crop_px - M_image[:2, 2]) / np.diag(M_image)[:2]
    known = np.isfinite(points).all(axis=1)
    if known.sum() < _MIN_CORRESPONDENCES:
        return None
    points, image_px = points[known], image_px[known]
    try:
        found, rotvec, t, inliers = cv2.solvePnPRansac(
            points,
            image_px,
            K,
            None,
            iterationsCount=settings.ransac_iterations,
            reprojectionError=settings.ransac_threshold_px,
            flags=cv2.SOLVEPNP_EPNP,
        )
    except cv2.error:  # degenerate points
        return None
    if not found or inliers is None:
        return None
    T = lie.transform(lie.so3_exp(np.asarray(rotvec, np.float64)[:, 0]), np.asarray(t, np.float64)[:, 0])
    return (T, len(inliers) / len(points)) if np.isfinite(T).all() else None


def fingerprint(state: dict[str, Tensor]) -> str:
    """Short digest of a state dict's values: what cached features depend on."""
    digest = hashlib.sha256()
    for name in sorted(state):
        value = state[name].double()
        digest.update(f"{name}:{tuple(value.shape)}:{value.sum().item()!r}:{value.abs().sum().item()!r}".encode())
    return digest.hexdigest()[:32]
