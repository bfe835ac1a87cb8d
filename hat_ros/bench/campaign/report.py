"""Tables of a campaign: by factor and stratum, clip by clip, and where two campaigns differ."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.campaign.intervals import bootstrap, median, ratio, wilson
from hat_ros.bench.campaign.run import Result
from hat_ros.bench.evaluation.tables import Column, Table

Members = Callable[[dict[str, Any]], bool]

_PHASES = ((0, 60), (60, 120), (120, 180))
_RATES = ((0.3, 0.7), (0.7, 1.7), (1.7, 4.0))
# Shares whose cases are frames: name, numerator and denominator among a clip's figures, heading.
_SHARES = (
    ("tracking_wrong", "tracking_wrong", "tracking", "TRACKING wrong %"),
    ("tracking_far", "tracking_far", "tracking", "TRACKING far %"),
    ("right_tracking", "right_tracking", "right", "right TRACKING %"),
    ("best_within", "best_within", "keyframes", "best of 10 %"),
    ("inside_95", "inside_95", "ellipsoids", "in 95 % %"),
    ("mask_iou", "mask_iou_sum", "masks", "IoU"),
)
_MEDIANS = (("first_right", "frames to right"), ("first_tracking", "to TRACKING"))
_TIMES = (("segmentation_ms", "Stage 1 cpu ms"), ("segmentation_ms_p99", "p99"), ("frame_ms", "frame cpu ms"))


def strata(results: Sequence[Result]) -> list[tuple[str, str, list[Result]]]:
    """Groups of clips as (factor, stratum, clips); empty ones are left out."""
    sizes = np.quantile([result.factors["size_px"] for result in results], (0, 1 / 3, 2 / 3, 1))
    groups: list[tuple[str, str, Members]] = [("all", "all", lambda f: True)]
    groups += [("background", name, _equals("background", name)) for name in ("sky", "earth", "limb")]
    groups += [
        ("sensor", "colour", lambda f: not f["grey"]),
        ("sensor", "grey", lambda f: bool(f["grey"])),
        ("sensor", "grey before earth", lambda f: f["grey"] and f["background"] == "earth"),
    ]
    groups += _bands("size px", "size_px", list(pairwise(sizes.tolist())))
    groups += _bands("phase deg", "phase_deg", _PHASES)
    groups += _bands("rate deg/frame", "rate_deg_per_frame", _RATES)
    for factor in ("mismatch", "craft"):
        names = sorted({str(result.factors[factor]) for result in results}, key=lambda name: (name != "none", name))
        groups += [(factor, name, _equals(factor, name)) for name in names]
    listed = [(factor, name, [r for r in results if member(r.factors)]) for factor, name, member in groups]
    return [group for group in listed if group[2]]


def _equals(factor: str, value: str) -> Members:
    return lambda factors: factors[factor] == value


def _bands(title: str, factor: str, edges: Sequence[tuple[float, float]]) -> Iterable[tuple[str, str, Members]]:
    """Neighbouring bands, the last one with its upper edge."""
    last = edges[-1][1]
    for low, high in edges:
        yield title, f"{low:.3g} to {high:.3g}", _within(factor, low, np.inf if high == last else high)


def _within(factor: str, low: float, high: float) -> Members:
    return lambda factors: low <= factors[factor] < high


def summary(results: Sequence[Result]) -> dict[str, Any]:
    """Figures of a group of clips, each with the bounds of its 95 % interval as ``NAME_low`` and ``NAME_high``."""
    n, found = len(results), sum(bool(result.figures["found"]) for result in results)
    low, high = wilson(found, n)
    row: dict[str, Any] = {"clips": n, "failed": sum(bool(result.failure) for result in results)}
    row |= {"found_clips": found, "found": found / n, "found_low": low, "found_high": high}
    for name, _ in _MEDIANS:
        values = _values(results, name)
        row[name] = float(median(values[None])[0])
        row[f"{name}_low"], row[f"{name}_high"] = bootstrap(values, median)
    for name, part, whole, _ in _SHARES:
        pairs = np.stack([_values(results, part), _values(results, whole)], axis=-1)
        row[name] = float(ratio(pairs[None])[0])
        row[f"{name}_low"], row[f"{name}_high"] = bootstrap(pairs, ratio)
    segmentation, frame = _series(results, "segmentation_ms"), _series(results, "frame_ms")
    if len(segmentation):
        row["segmentation_ms"], row["frame_ms"] = float(segmentation.mean()), float(frame.mean())
        row["segmentation_ms_p99"] = float(np.percentile(segmentation, 99))
    return row


def _values(results: Sequence[Result], name: str) -> Float:
    return np.array([float(result.figures[name]) for result in results])


def _series(results: Sequence[Result], name: str) -> Float:
    return np.array([value for result in results for value in result.series.get(name, ())], dtype=np.float64)


def strata_rows(results: Sequence[Result]) -> list[dict[str, Any]]:
    """A row per stratum."""
    return [{"factor": factor, "stratum": name} | summary(members) for factor, name, members in strata(results)]


def numbers_table(title: str, rows: Sequence[dict[str, Any]]) -> Table:
    """All figures and bounds in full, for CSV and JSON; a median that is infinite is null there."""
    keys = dict.fromkeys(key for row in rows for key in row)
    plain = [{key: None if value in (np.inf, -np.inf) else value for key, value in row.items()} for row in rows]
    return Table(title, [Column(key, key) for key in keys], plain)


def shown_table(title: str, rows: Sequence[dict[str, Any]]) -> Table:
    """What people read: figures with their intervals in brackets."""
    columns = [Column("factor", "factor"), Column("stratum", "stratum"), Column("clips", "clips", "d")]
    columns += [Column("found", "found %")]
    columns += [Column(name, heading) for name, heading in _MEDIANS]
    columns += [Column(name, heading) for name, _, _, heading in _SHARES]
    columns += [Column(name, heading, ".1f") for name, heading in _TIMES]
    return Table(title, columns, [_shown(row) for row in rows])


def _shown(row: dict[str, Any]) -> dict[str, Any]:
    cells = dict(row)
    for name in ("found", *(name for name, *_ in _SHARES)):
        cells[name] = _with_bounds(row, name, _overlap if name == "mask_iou" else _percent)
    for name, _ in _MEDIANS:
        cells[name] = _with_bounds(row, name, _frames)
    return cells


def _with_bounds(row: dict[str, Any], name: str, form: Callable[[float], str]) -> str:
    if np.isnan(row[name]):
        return "-"
    return f"{form(row[name])} ({form(row[f'{name}_low'])}-{form(row[f'{name}_high'])})"


def _percent(share: float) -> str:
    return f"{100 * share:.0f}"


def _overlap(value: float) -> str:
    return f"{value:.2f}"


def _frames(count: float) -> str:
    return "never" if np.isinf(count) else f"{count:.0f}"


def described(result: Result) -> str:
    """A clip in one line."""
    f = result.factors
    sensor = "grey" if f["grey"] else "colour"
    return (
        f"{result.index:06d} {f['craft']}: {f['background']}, {sensor}, {f['size_px']:.0f} px, phase "
        f"{f['phase_deg']:.0f} deg, {f['rate_deg_per_frame']:.1f} deg/frame, mismatch {f['mismatch']}"
    )


def clips_table(results: Sequence[Result]) -> Table:
    """A row per clip in full: what it showed, what came of it."""
    rows = [{"clip": r.index} | r.factors | r.figures | {"failure": r.failure} for r in results]
    return numbers_table("clips", rows)


def shown_clips(results: Sequence[Result]) -> Table:
    """A line per clip for people."""
    rows = []
    for result in results:
        f = result.figures
        masks = f["masks"]
        rows.append(
            {
                "clip": described(result),
                "found": "found" if f["found"] else result.failure or "lost",
                "E_p_mean": f["E_p_mean"],
                "coverage": f["coverage"],
                "first_right": f["first_right"],
                "wrong": f["tracking_wrong"],
                "mask_iou": f["mask_iou_sum"] / masks if masks else float("nan"),
            }
        )
    return Table("clips", _CLIP_COLUMNS, rows)


_CLIP_COLUMNS = (
    Column("clip", "clip"),
    Column("found", "found"),
    Column("E_p_mean", "E_p", ".4f"),
    Column("coverage", "coverage", ".0%"),
    Column("first_right", "frames to right", ".0f"),
    Column("wrong", "TRACKING wrong", "d"),
    Column("mask_iou", "IoU", ".2f"),
)
