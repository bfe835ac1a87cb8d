"""Boolean images."""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Bool


def overlap(a: Bool, b: Bool) -> float:
    """Intersection over union; 0 when both are empty."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 0.0
