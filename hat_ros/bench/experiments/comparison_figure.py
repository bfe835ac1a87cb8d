"""The paper's summary figure: mean E_p as bars, one SD as whiskers, frames per second as diamonds; a panel per clip."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_COLOR = {"hat": "#20406a", "offline": "#7f9fc8"}
_BASELINE_COLOR = "#b5b5b5"
_DIAMOND_COLOR = "#e07b00"
_PANELS_PER_ROW = 4


def bench_figure(rows: Sequence[dict[str, Any]], panel: str = "clip") -> Figure:
    """One panel per value of the column ``panel``; within it a bar per row.

    Args:
        rows: of the benchmark table; rows without figures show as empty places.
        panel: the column that makes the panels.
    """
    names = list(dict.fromkeys(row[panel] for row in rows))
    columns = min(_PANELS_PER_ROW, len(names))
    lines = math.ceil(len(names) / columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(3.1 * columns + 0.6, 3.2 * lines), layout="constrained", squeeze=False
    )
    for axis, name in zip(axes.flat, names, strict=False):
        _panel(axis, [row for row in rows if row[panel] == name])
        axis.set_title(str(name), fontsize=10)
    for axis in axes.flat[len(names) :]:
        axis.set_visible(False)
    figure.supxlabel("bars: mean $E_p$, whiskers: one SD, diamonds: frames/s", fontsize=8, color="#555555")
    return figure


def _panel(axis: Axes, rows: Sequence[dict[str, Any]]) -> None:
    labels = [_label(row, rows) for row in rows]
    x = np.arange(len(rows))
    mean, sd, fps = (np.array([_number(row.get(key)) for row in rows]) for key in ("E_p_mean", "E_p_sd", "fps"))
    axis.bar(x, mean, color=[_COLOR.get(row.get("method", ""), _BASELINE_COLOR) for row in rows], width=0.65)
    has_sd = np.isfinite(mean) & np.isfinite(sd)
    upwards = [np.zeros(np.count_nonzero(has_sd)), sd[has_sd]]
    axis.errorbar(x[has_sd], mean[has_sd], yerr=upwards, fmt="none", ecolor="#444444", capsize=3, linewidth=1)
    for at, top, value in zip(x, mean + np.nan_to_num(sd), mean, strict=True):
        if np.isfinite(value):
            # Three digits: bars of a good method are too low to be read against those of a bad one.
            axis.annotate(f"{value:.3g}", (at, top), (0, 2), textcoords="offset points", ha="center", fontsize=7)
    axis.set_xticks(x, labels, rotation=30, ha="right", fontsize=8)
    axis.set_ylabel("$E_p$", fontsize=9)
    axis.margins(y=0.12)
    axis.set_ylim(bottom=0)
    speed = axis.twinx()
    for at, rate, row in zip(x, fps, rows, strict=True):
        size = 8 if row.get("method") in _COLOR else 5
        speed.plot(at, rate, "D", color=_DIAMOND_COLOR, markersize=size, markeredgecolor="black", markeredgewidth=0.6)
    speed.set_ylabel("frames/s", fontsize=9, color=_DIAMOND_COLOR)
    fastest = np.nanmax(fps) if np.isfinite(fps).any() else 1.0
    speed.set_ylim(0, 1.15 * fastest)


def _label(row: dict[str, Any], rows: Sequence[dict[str, Any]]) -> str:
    """The mode, and whatever else tells the bars of one panel apart."""
    parts = [row["mode"]]
    for key in ("masks", "start"):
        told = {other.get(key) for other in rows} - {"-"}
        if len(told) > 1 and row.get(key) in told:
            parts.append(f"{key} {row[key]}")
    return ", ".join(parts)


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)
