"""Bars of an ablation table: mean E_p of every row, one SD as whisker, in the order of the table."""

from __future__ import annotations

from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from hat_ros.bench.evaluation.figures import range_figure
from hat_ros.bench.evaluation.tables import Table

_BAR_COLOR = "#20406a"
_BARS_COLOR = ("#b5b5b5", "#20406a", "#7f9fc8", "#c98f3d", "#e3c28f")


def table_figure(table: Table) -> Figure | None:
    """Horizontal bars, first row on top: mean E_p, one SD and the figure; where rows are clips, of every column.

    Errors by range become curves; the table of candidates has no figure.
    """
    rows, keys = table.rows, {column.key for column in table.columns}
    if "depth_m_median" in keys:
        return range_figure(list(rows))
    if "oracle_median_deg" in keys:
        return None
    if "E_p_mean" not in keys:
        return _grouped(table)
    figure, axis = plt.subplots(figsize=(7.0, 0.34 * len(rows) + 0.9), layout="constrained")
    mean, sd = (_numbers(rows, key) for key in ("E_p_mean", "E_p_sd"))
    y = np.arange(len(rows))
    axis.barh(y, mean, height=0.62, color=_BAR_COLOR)
    rightwards = [np.zeros(len(rows)), np.nan_to_num(sd)]
    axis.errorbar(mean, y, xerr=rightwards, fmt="none", ecolor="#888888", capsize=2, linewidth=1)
    for level, end in zip(y, mean + rightwards[1], strict=True):
        if np.isfinite(end):
            axis.annotate(f"{mean[level]:.4f}", (end, level), (4, 0), textcoords="offset points", va="center", size=7)
    axis.margins(x=0.12)
    axis.set_xlim(left=0.0)
    _finish(figure, table, [str(row[table.columns[0].key]) for row in rows])
    return figure


def _grouped(table: Table) -> Figure:
    rows, columns = table.rows, table.columns[1:]
    height = 0.8 / len(columns)
    figure, axis = plt.subplots(figsize=(7.0, 0.9 * len(rows) + 1.2), layout="constrained")
    for i, column in enumerate(columns):
        y = np.arange(len(rows)) + (i - 0.5 * (len(columns) - 1)) * height
        axis.barh(y, _numbers(rows, column.key), height, color=_BARS_COLOR[i % len(_BARS_COLOR)], label=column.title)
    axis.set_xscale("log")
    axis.legend(fontsize=8)
    _finish(figure, table, [str(row[table.columns[0].key]) for row in rows])
    return figure


def _finish(figure: Figure, table: Table, names: list[str]) -> None:
    axis = figure.axes[0]
    axis.set_yticks(np.arange(len(names)), names, fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("$E_p$", fontsize=9)
    axis.set_title(table.title.replace("E_p", "$E_p$"), fontsize=10)
    axis.spines[["top", "right"]].set_visible(False)


def _numbers(rows: list[dict[str, Any]], key: str) -> np.ndarray:
    return np.array([np.nan if row.get(key) is None else float(row[key]) for row in rows])
