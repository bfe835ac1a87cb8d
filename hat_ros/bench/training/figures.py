"""What a trained segmentation network does on craft kept aside: overlap of its masks, calibration of its log-odds."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from hat_ros.array_types import Bool, Float
from hat_ros.bench.training.fit import overlaps
from hat_ros.bench.training.model import Segmenter
from hat_ros.bench.training.samples import Composer

# Classes of size: the square root of the target's area in a sample, pixels at the network's scale.
SIZE_LIMITS_PX = (0.0, 15.0, 30.0, 60.0, float("inf"))


@dataclass(frozen=True)
class OverlapRow:
    """Mean intersection over union of masks and truth in one class of samples; NaN where there are none.

    Attributes:
        low_px: least size, square root of the target's area.
        high_px: size below which samples belong here.
        samples: with a target.
        evidence: of masks from the image alone.
        primed: of ``samples``, those with a prior silhouette, right or wrong.
        evidence_primed: of masks from the image alone, on these.
        tracked: of masks given the prior, on these.
    """

    low_px: float
    high_px: float
    samples: int
    evidence: float
    primed: int
    evidence_primed: float
    tracked: float


def overlap_rows(model: Segmenter, composer: Composer, count: int) -> list[OverlapRow]:
    """All samples of the first ``count`` that hold a target, then each class of size."""
    found = overlaps(model, composer, count)
    samples = (composer.sample(number) for number in range(count))
    about = [(np.sqrt((sample.target > 0.5).sum()), (sample.prior != 0).any()) for sample in samples]
    size, primed = (np.array(column) for column in zip(*about, strict=True))
    spans = [(SIZE_LIMITS_PX[0], SIZE_LIMITS_PX[-1]), *pairwise(SIZE_LIMITS_PX)]
    held = np.isfinite(found[:, 0])
    return [_row(low, high, found, held & (size >= low) & (size < high), primed) for low, high in spans]


def _row(low: float, high: float, found: Float, chosen: Bool, primed: Bool) -> OverlapRow:
    both = chosen & primed
    evidence, (evidence_primed, tracked) = _mean(found[chosen, 0]), (_mean(found[both, k]) for k in (0, 1))
    return OverlapRow(low, high, int(chosen.sum()), evidence, int(both.sum()), evidence_primed, tracked)


def _mean(values: Float) -> float:
    return float(values.mean()) if len(values) else float("nan")


def curve_rows(curve: Float) -> list[dict[str, Any]]:
    """The calibration curve (10, 4) of :func:`hat_ros.bench.training.fit.calibrate`, one row per bin."""
    return [
        {"from": low, "to": low + 0.1, "stated": stated, "target": target, "pixels": int(pixels)}
        for low, stated, target, pixels in curve.tolist()
    ]
