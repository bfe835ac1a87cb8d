"""Causal refinement of fused poses on their own image (the paper's dense refinement, online)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hat_ros.config import HatConfig
from hat_ros.target.model import Target

if TYPE_CHECKING:
    from hat_ros.refinement.contour_refiner import FusedPoseRefiner


def create_refiner(config: HatConfig, target: Target) -> FusedPoseRefiner | None:
    """The refiner of the fused pose, None when ``refinement.enabled`` is false."""
    if not config.refinement.enabled:
        return None
    from hat_ros.refinement.contour_refiner import FusedPoseRefiner

    return FusedPoseRefiner(config.refinement, target)
