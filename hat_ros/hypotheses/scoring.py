"""How much the image speaks for a pose: evidence per candidate, and its log-likelihood.

Overlap of silhouette and mask comes first. It is expressed as the mean distance between the two outlines in pixels, so
that it means the same for a target of 60 and of 600 pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hat_ros.refinement.refiner import Fit
from hat_ros.refinement.view import MaskField, TargetViewer
from hat_ros.types import Frame


@dataclass(frozen=True)
class Evidence:
    """What was measured for one candidate.

    Attributes:
        overlap: intersection over union with the mask, inside the image.
        extra: mask without silhouette, as a share of the union.
        missing: silhouette without mask, as a share of the union.
        support: share of the contour that agrees with the image.
    """

    overlap: float
    extra: float
    missing: float
    support: float


def evidence(viewer: TargetViewer, fit: Fit, frame: Frame, field: MaskField, render_px: int) -> Evidence | None:
    """Gather the evidence for a refined pose; None when it cannot be seen."""
    view = viewer.view(fit.T_cam_target, frame.camera, render_px)
    if view is None:
        return None
    common, extra, missing = field.compare(view)
    union = max(common + extra + missing, 1e-9)
    return Evidence(common / union, extra / union, missing / union, fit.support)


def log_scores(found: list[Evidence]) -> NDArray[np.float64]:
    """(K,) log-likelihoods up to a common constant."""
    return np.array([40.0 * e.overlap for e in found])
