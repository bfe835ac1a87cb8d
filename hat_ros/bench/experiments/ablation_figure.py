"""Bars of an ablation table: mean E_p of every row, one SD as whisker, in the order of the table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from hat_ros.array_types import Float
from hat_ros.bench.evaluation.figures import range_figure
from hat_ros.bench.evaluation.tables import Table

_BAR_COLOR = "#20406a"


def table_figure(table: Table) -> Figure | None:
    """Horizontal bars, first row on top: mean E_p, one SD and the figure.

    Errors by range become curves; tables whose rows are clips have no figure.
    """
    rows, keys = table.rows, {column.key for column in table.columns}
    if "depth_m_median" in keys:
        return range_figure(list(rows))
    if "E_p_mean" not in keys or "clip" in keys:
        return None
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
    axis.set_yticks(y, [str(row[table.columns[0].key]) for row in rows], fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("$E_p$", fontsize=9)
    axis.set_title(table.title, fontsize=10)
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def _numbers(rows: Sequence[dict[str, Any]], key: str) -> Float:
    return np.array([np.nan if row.get(key) is None else float(row[key]) for row in rows])
