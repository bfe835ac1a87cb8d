"""How sure the figures of a campaign are: 95 % intervals over its clips."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hat_ros.array_types import Float

_RESAMPLES = 1000
# 97.5 % quantile of the standard normal distribution.
_Z = 1.959963984540054


def wilson(count: int, total: int) -> tuple[float, float]:
    """95 % interval of a proportion; NaN without cases.

    Source: Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22 (1927).
    """
    if total == 0:
        return float("nan"), float("nan")
    share, spread = count / total, _Z**2 / total
    middle = (share + spread / 2) / (1 + spread)
    half = np.sqrt(share * (1 - share) * spread + spread**2 / 4) / (1 + spread)
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))


def bootstrap(values: Float, statistic: Callable[[Float], Float]) -> tuple[float, float]:
    """95 % percentile interval of a statistic over clips, drawn with replacement; the same data give the same bounds.

    Args:
        values: (N,) or (N, M) a row per clip, infinities allowed.
        statistic: of B samples at once, (B, N) or (B, N, M) -> (B,); NaN where a sample has no figure.

    Returns:
        Both bounds; NaN where no sample has a figure.
    """
    n = len(values)
    if n == 0:
        return float("nan"), float("nan")
    picks = np.random.default_rng(0).integers(n, size=(_RESAMPLES, n))
    found = statistic(values[picks])
    found = np.sort(found[~np.isnan(found)])
    if not len(found):
        return float("nan"), float("nan")
    low, high = (found[round(share * (len(found) - 1))] for share in (0.025, 0.975))
    return float(low), float(high)


def ratio(samples: Float) -> Float:
    """Sum over sum of samples (B, N, 2): a share whose cases are frames, drawn clip by clip."""
    totals = samples.sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.where(totals[:, 1] > 0, totals[:, 0] / np.maximum(totals[:, 1], 1e-300), np.nan)


def median(samples: Float) -> Float:
    """Median of samples (B, N); infinite where half of the clips are."""
    ordered = np.sort(samples, axis=1)
    n = samples.shape[1]
    return 0.5 * (ordered[:, (n - 1) // 2] + ordered[:, n // 2])
