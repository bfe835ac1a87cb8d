"""The figures of a clip, from what came out of it frame by frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from hat_ros.array_types import Bool, Float
from hat_ros.bench.campaign.play import Played
from hat_ros.bench.evaluation.metrics import FALSE_TRACKING_DEG
from hat_ros.types import TrackState

# A pose this good is right; one that is worse than the other is wrong, and must not be called TRACKING.
RIGHT_E_P, WRONG_E_P = 0.05, 0.1
# A pose beyond this, or beyond FALSE_TRACKING_DEG, is no pose of the target at all.
FAR_E_P = 0.6
# A clip is found when its mean E_p is below WRONG_E_P with a pose on this share of its frames.
FOUND_COVERAGE = 0.9
# The best of ten hypotheses is good enough within this angle.
BEST_WITHIN_DEG = 15.0


def figures_of(played: Played) -> dict[str, Any]:
    """Figures of one clip; counts where a share of several clips needs them, infinite where nothing was reached."""
    e_p, tracking = played.e_p, played.state == TrackState.TRACKING
    scored = np.isfinite(e_p)
    right, wrong = scored & (e_p < RIGHT_E_P), scored & (e_p > WRONG_E_P)
    far = scored & ((e_p > FAR_E_P) | (np.nan_to_num(played.rotation_deg) > FALSE_TRACKING_DEG))
    mean = float(np.mean(e_p[scored])) if scored.any() else float("inf")
    coverage = float(np.mean(scored))
    overlaps, best = (values[np.isfinite(values)] for values in (played.mask_iou, played.best_deg))
    inside = played.inside_95[tracking & np.isfinite(played.inside_95)]
    return {
        "found": bool(mean < WRONG_E_P and coverage >= FOUND_COVERAGE),
        "E_p_mean": mean,
        "E_p_plain_mean": float(np.mean(played.e_p_plain[scored])) if scored.any() else float("inf"),
        "coverage": coverage,
        "frames": len(e_p),
        "first_right": _first(right),
        "first_tracking": _first(tracking),
        "tracking": _count(tracking),
        "tracking_wrong": _count(tracking & wrong),
        "tracking_far": _count(tracking & far),
        "right": _count(right),
        "right_tracking": _count(right & tracking),
        "masks": len(overlaps),
        "mask_iou_sum": float(overlaps.sum()),
        "keyframes": len(best),
        "best_within": _count(best <= BEST_WITHIN_DEG),
        "ellipsoids": len(inside),
        "inside_95": _count(inside > 0),
        "segmentation_ms_mean": float(played.segmentation_ms.mean()),
        "segmentation_ms_p99": float(np.percentile(played.segmentation_ms, 99)),
        "frame_ms_mean": float(played.frame_ms.mean()),
    }


def figures_of_failure(frames: int) -> dict[str, Any]:
    """Figures of a clip that could not be played: not found, no pose, no mask."""
    nothing = {"found": False, "coverage": 0.0, "frames": frames}
    nothing |= {"E_p_mean": float("inf"), "E_p_plain_mean": float("inf")}
    never = {"first_right": float("inf"), "first_tracking": float("inf")}
    counts = dict.fromkeys(("tracking", "tracking_wrong", "tracking_far", "right", "right_tracking"), 0)
    # Each of its masks is missing, so each counts 0.
    masks = {"masks": frames, "mask_iou_sum": 0.0}
    rest = dict.fromkeys(("keyframes", "best_within", "ellipsoids", "inside_95"), 0)
    times = dict.fromkeys(("segmentation_ms_mean", "segmentation_ms_p99", "frame_ms_mean"), float("nan"))
    return nothing | never | counts | masks | rest | times


def _count(flags: Bool) -> int:
    return int(np.count_nonzero(flags))


def _first(flags: Bool) -> float:
    """Frames until the first one that is set, itself included."""
    at = np.flatnonzero(flags)
    return float(at[0] + 1) if len(at) else float("inf")


def rounded(values: Float) -> list[float | None]:
    """Numbers for a JSON file that people may read, null where there is none."""
    return [round(float(value), 5) if np.isfinite(value) else None for value in values]
