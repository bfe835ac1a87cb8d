"""Mask2Former (COCO instances) through `transformers`, with a choice rule for a target that is no COCO class.

Cheng et al., "Masked-attention Mask Transformer for Universal Image Segmentation", CVPR 2022. The published weights are
CC BY-NC 4.0 (non-commercial). They are read from a local folder only. A spacecraft comes out as an airplane, a kite, a
boat: the class is ignored. Among the instances, the one wins whose score, size, compactness and overlap with the
previous mask are best together; the paper does not publish its rule.
"""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
import torch

from hat_ros.array_types import Bool, Float32
from hat_ros.config import HatConfig, Mask2FormerConfig
from hat_ros.nets.checkpoint import find
from hat_ros.nets.mask2former_files import load_mask2former
from hat_ros.nets.runtime import Runtime
from hat_ros.target.model import Target
from hat_ros.types import Detection, Frame, PosePrior

# An instance that fills more of the image than this is its background.
_MAX_SHARE = 0.95


class Mask2FormerSegmenter:
    """Stage 1 backend ``mask2former``; see the module's text.

    Raises:
        WeightsError: the weights folder is missing or cannot be read.
    """

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._settings = config.segmentation.mask2former
        self._runtime = Runtime(config.nets, "mask2former")
        folder = find("mask2former", config.nets.weights_folder or None)
        self._processor, model = load_mask2former(folder)
        # The library's decorator hides what the method takes.
        model = model.to(self._runtime.device)  # type: ignore[arg-type]
        self._model = model.eval().requires_grad_(False)
        self._previous: Bool | None = None

    @torch.inference_mode()
    def update(self, frame: Frame, prior: PosePrior | None) -> Detection | None:
        """The chosen instance, None when none scores ``min_score``; the prior is not used (published behaviour)."""
        inputs = self._processor(images=frame.rgb, return_tensors="pt").to(self._runtime.device)
        with torch.autocast(
            self._runtime.device.type, dtype=self._runtime.dtype, enabled=self._runtime.reduced_precision
        ):
            outputs = self._model(**inputs)
        padded = tuple(inputs["pixel_values"].shape[-2:])
        visible = tuple(int(n) for n in inputs["pixel_mask"][0].nonzero().amax(dim=0) + 1)
        masks, scores = instances(
            outputs.class_queries_logits[0].float(),
            outputs.masks_queries_logits[0].float(),
            (padded, visible, frame.rgb.shape[:2]),
            self._settings.min_score,
        )
        chosen = choose(masks.cpu().numpy(), scores.cpu().numpy(), self._previous, self._settings)
        if chosen is None:
            return None
        self._previous = chosen
        return Detection(chosen)

    def reset(self) -> None:
        """Forget the previous mask."""
        self._previous = None


def instances(
    class_logits: torch.Tensor,
    mask_logits: torch.Tensor,
    sizes: tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]],
    min_score: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Instance masks and scores from the network's queries: the published post-processing without the classes.

    Each query counts once, with its likeliest class, and those that cannot reach ``min_score`` are left out before
    their masks are brought to full size.

    Args:
        class_logits: (Q, C + 1), the last class is "no object".
        mask_logits: (Q, h, w).
        sizes: (height, width) of the network's input, of the part of it that is image, and of the original image.
        min_score: least score that is of interest.

    Returns:
        (N, H, W) bool masks and (N,) scores: class probability times mean mask probability inside the mask.
    """
    probability = class_logits.softmax(dim=1)[:, :-1].amax(dim=1)
    kept = probability >= min_score  # the mean inside the mask is at most one
    if not kept.any():
        return torch.zeros(0, *sizes[2], dtype=torch.bool), torch.zeros(0)
    padded_hw, visible_hw, image_hw = sizes
    resize = partial(torch.nn.functional.interpolate, mode="bilinear", align_corners=False)
    logits = resize(mask_logits[kept][None], size=padded_hw)[..., : visible_hw[0], : visible_hw[1]]
    logits = resize(logits, size=image_hw)[0]
    masks = logits > 0
    quality = (logits.sigmoid() * masks).flatten(1).sum(dim=1) / (masks.flatten(1).sum(dim=1) + 1e-6)
    return masks, probability[kept] * quality


def choose(
    masks: Bool,
    scores: Float32,
    previous: Bool | None,
    settings: Mask2FormerConfig,
) -> Bool | None:
    """The instance that is the target: (N, H, W), (N,) -> (H, W), or None.

    Merit = score x (1 + square root of the share of the image) + weighted compactness (share of the convex hull that
    is filled) + weighted overlap with the previous mask; instances that fill nearly the whole image are background.
    """
    best, best_merit = None, 0.0
    for mask, score in zip(masks, scores, strict=True):
        share = float(mask.mean())
        if score < settings.min_score or not 0 < share < _MAX_SHARE:
            continue
        merit = float(score) * (1.0 + np.sqrt(share)) + settings.compactness_weight * _compactness(mask)
        if previous is not None:
            overlap = np.count_nonzero(mask & previous) / np.count_nonzero(mask | previous)
            merit += settings.temporal_weight * overlap
        if merit > best_merit:
            best, best_merit = mask, merit
    return best


def _compactness(mask: Bool) -> float:
    points = cv2.findNonZero(mask.astype(np.uint8)).reshape(-1, 2)
    hull = cv2.contourArea(cv2.convexHull(points))
    return min(np.count_nonzero(mask) / max(hull, 1.0), 1.0)
