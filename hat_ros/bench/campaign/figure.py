"""Figures of a campaign: share found by stratum, and the map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_COLOR = "#20406a"
_BACKGROUNDS = {"sky": "black sky", "earth": "before the Earth", "limb": "before the limb"}


def strata_figure(rows: Sequence[dict[str, Any]]) -> Figure:
    """Share found with its 95 % interval, a line per stratum, first one on top."""
    figure, axis = plt.subplots(figsize=(7.0, 0.24 * len(rows) + 0.9), layout="constrained")
    y = np.arange(len(rows))
    found, low, high = (np.array([100 * row[key] for row in rows]) for key in ("found", "found_low", "found_high"))
    axis.hlines(y, low, high, color="#7f9fc8", linewidth=3)
    axis.plot(found, y, "o", color=_COLOR, markersize=5)
    for level, row in enumerate(rows):
        axis.annotate(f"{row['found_clips']}/{row['clips']}", (101, level), va="center", fontsize=7, color="#555555")
        if level and row["factor"] != rows[level - 1]["factor"]:
            axis.axhline(level - 0.5, color="#cccccc", linewidth=0.7)
    axis.set_yticks(y, [_label(row) for row in rows], fontsize=8)
    axis.set_ylim(len(rows) - 0.4, -0.6)
    axis.set_xlim(-2, 110)
    axis.set_xticks(range(0, 101, 20))
    axis.grid(True, axis="x", alpha=0.3)
    axis.set_xlabel("clips found, %, with 95 % interval (Wilson)", fontsize=9)
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def _label(row: dict[str, Any]) -> str:
    """Names speak for themselves, numbers need their factor."""
    named = row["factor"] in ("all", "background", "sensor", "craft")
    return str(row["stratum"]) if named else f"{row['factor']}: {row['stratum']}"


def map_figure(rows: Sequence[dict[str, Any]]) -> Figure:
    """Share found over size and phase angle, a panel per background; empty where no clip was drawn."""
    backgrounds = list(dict.fromkeys(row["background"] for row in rows))
    figure, axes = plt.subplots(
        1, len(backgrounds), figsize=(3.6 * len(backgrounds) + 0.8, 3.6), layout="constrained", squeeze=False
    )
    sizes, phases = (_edges(rows, f"{name}_low_{unit}", f"{name}_high_{unit}") for name, unit in _AXES)
    ranges = {row[f"size_{a}_px"]: row[f"range_{b}_m"] for row in rows for a, b in _NEARER if "range_low_m" in row}
    for axis, background in zip(axes.flat, backgrounds, strict=True):
        mesh = _panel(axis, [row for row in rows if row["background"] == background], sizes, phases)
        axis.set_title(_BACKGROUNDS[background], fontsize=10)
        axis.set_xlabel("diameter in the image, px" + (", and range, m" if ranges else ""), fontsize=9)
        axis.set_xticks(range(len(sizes)), [_tick(size, ranges) for size in sizes], fontsize=8)
    axes[0, 0].set_ylabel("phase angle, deg (0: sun behind the camera)", fontsize=9)
    figure.colorbar(mesh, ax=axes, label="share of clips found", shrink=0.9)
    return figure


_AXES = (("size", "px"), ("phase", "deg"))
# The larger the craft, the nearer it is.
_NEARER = (("low", "high"), ("high", "low"))


def _tick(size_px: float, ranges: dict[float, float]) -> str:
    return f"{size_px:.0f}\n{ranges[size_px]:.3g} m" if size_px in ranges else f"{size_px:.0f}"


def _edges(rows: Sequence[dict[str, Any]], low: str, high: str) -> list[float]:
    return sorted({row[low] for row in rows} | {row[high] for row in rows})


def _panel(axis: Axes, rows: Sequence[dict[str, Any]], sizes: list[float], phases: list[float]) -> Any:
    share = np.full((len(phases) - 1, len(sizes) - 1), np.nan)
    for row in rows:
        at = phases.index(row["phase_low_deg"]), sizes.index(row["size_low_px"])
        share[at] = row["found"]
        place = at[1] + 0.5, at[0] + 0.5
        color = "white" if row["found"] < 0.55 else "black"
        axis.annotate(f"{row['found_clips']}/{row['clips']}", place, ha="center", va="center", fontsize=9, color=color)
    mesh = axis.pcolormesh(share, vmin=0, vmax=1, cmap="viridis", edgecolors="white", linewidth=0.8)
    axis.set_facecolor("#e6e6e6")
    axis.set_yticks(range(len(phases)), [f"{phase:.0f}" for phase in phases], fontsize=8)
    return mesh
