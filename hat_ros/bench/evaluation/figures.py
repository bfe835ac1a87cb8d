"""Plots of one run, drawn without a display."""

from __future__ import annotations

import io

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from hat_ros.array_types import Float
from hat_ros.bench.evaluation import metrics
from hat_ros.geometry import lie
from hat_ros.io.run_log import RunLog
from hat_ros.types import TrackState

STATE_COLOR = {
    TrackState.UNINITIALISED: "#bbbbbb",
    TrackState.TRACKING: "#7fd6a0",
    TrackState.COASTING: "#ffd27f",
    TrackState.LOST: "#ff9c9c",
    TrackState.INITIALISING: "#cdb4f0",
}


def seconds(log: RunLog) -> Float:
    """(N,) time since the first frame."""
    return (log.stamp_ns - log.stamp_ns[0]) * 1e-9 if len(log) else np.zeros(0)


def error_figure(log: RunLog) -> Figure:
    """Errors over time with keyframes, anchors, resets and states marked; without ground truth the poses."""
    if not log.has_truth.any():
        return pose_figure(log)
    errors = metrics.pose_errors(log.T_est, log.T_true)
    t = seconds(log)
    figure, axes = plt.subplots(
        4, 1, figsize=(10, 8.5), sharex=True, height_ratios=(3, 3, 3, 1.1), layout="constrained"
    )
    rows = (
        (axes[0], np.degrees(errors.rotation_rad), "rotation error E$_q$ (deg)", (0.05, 200)),
        (axes[1], errors.translation_m, "translation error E$_t$ (m)", (1e-3, None)),
        (axes[2], errors.pose, "pose error E$_p$", (1e-3, None)),
    )
    for axis, values, label, (low, high) in rows:
        _shade_states(axis, t, log)
        axis.plot(t, values, color="#20406a", linewidth=1.2)
        axis.set_yscale("log")
        axis.set_ylabel(label)
        finite = values[np.isfinite(values)]
        axis.set_ylim(low, high if high else max(10 * low, 2 * finite.max() if len(finite) else 1.0))
        axis.grid(True, which="major", alpha=0.3)
        for moment in t[log.reset]:
            axis.axvline(moment, color="#b00020", linestyle="--", linewidth=1)
    anchors = log.anchor_errors_deg()
    best = metrics.best_of_k_deg([group.pose_rows for group in log.candidates], log.T_true)
    at = log.keyframe & np.isfinite(best)
    axes[0].plot(t[at], np.maximum(best[at], 0.05), "x", color="#888888", markersize=4, label="best candidate")
    axes[0].plot(t, np.maximum(anchors, 0.05), "o", color="#e07b00", markersize=3.5, label="anchor chosen")
    axes[0].axhline(90, color="#999999", linewidth=0.6)
    axes[0].legend(loc="upper right", fontsize=8, ncols=2)
    _event_rows(axes[3], t, log)
    return figure


def pose_figure(log: RunLog) -> Figure:
    """Position and rotation since the first pose, over time."""
    figure, axes = plt.subplots(3, 1, figsize=(10, 7), sharex=True, height_ratios=(3, 3, 1.1), layout="constrained")
    t, T = seconds(log), log.T_est
    for axis in axes[:2]:
        _shade_states(axis, t, log)
        axis.grid(True, alpha=0.3)
    for i, name in enumerate("xyz"):
        axes[0].plot(t, T[:, i, 3], label=name, linewidth=1.2)
    axes[0].set_ylabel("target in camera (m)")
    axes[0].legend(fontsize=8)
    has = np.flatnonzero(log.has_output)
    turned = np.full(len(log), np.nan)
    if len(has):
        turned[has] = np.degrees(lie.angle_between(T[has, :3, :3], T[has[0], :3, :3]))
    axes[1].plot(t, turned, color="#20406a", linewidth=1.2)
    axes[1].set_ylabel("rotation since first pose (deg)")
    _event_rows(axes[2], t, log)
    return figure


def range_figure(bins: list[dict[str, float]]) -> Figure:
    """Rotation and signed depth error by range: medians and quartiles, as the paper draws them."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
    middle = [(b["depth_from_m"] + b["depth_to_m"]) / 2 for b in bins]
    for axis, key, label in (
        (axes[0], "rotation_deg", "rotation error (deg)"),
        (axes[1], "depth_m", "depth error (m)"),
    ):
        axis.fill_between(
            middle, [b[f"{key}_q25"] for b in bins], [b[f"{key}_q75"] for b in bins], color="#7f9fc8", alpha=0.4
        )
        axis.plot(middle, [b[f"{key}_median"] for b in bins], "o-", color="#20406a", markersize=4)
        axis.set_xlabel("depth, ground truth (m)")
        axis.set_ylabel(label)
        axis.grid(True, alpha=0.3)
    axes[1].axhline(0, color="#999999", linewidth=0.6)
    return figure


def image_bytes(figure: Figure, form: str = "png", dpi: int = 110) -> bytes:
    """The figure as png, svg or pdf, without dates, so that the same data give the same bytes; the figure is closed."""
    out = io.BytesIO()
    undated = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[form]
    with matplotlib.rc_context({"svg.hashsalt": "hat_ros"}):
        figure.savefig(out, format=form, dpi=dpi, metadata=undated)
    plt.close(figure)
    return out.getvalue()


def _shade_states(axis: Axes, t: Float, log: RunLog) -> None:
    for state, first, last in _spans(log):
        axis.axvspan(t[first], t[min(last + 1, len(t) - 1)], color=STATE_COLOR[state], alpha=0.28, linewidth=0)


def _spans(log: RunLog) -> list[tuple[TrackState, int, int]]:
    """Runs of equal state: (state, first frame, last frame)."""
    if not len(log):
        return []
    edges = np.flatnonzero(np.diff(log.state)) + 1
    starts = np.concatenate([[0], edges])
    ends = np.concatenate([edges, [len(log)]]) - 1
    return [(TrackState(int(log.state[a])), int(a), int(b)) for a, b in zip(starts, ends, strict=True)]


def _event_rows(axis: Axes, t: Float, log: RunLog) -> None:
    """Keyframes, anchors, gated anchors and resets as ticks; states as coloured bands with a legend."""
    _shade_states(axis, t, log)
    gated = (log.anchor >= 0) & (log.gate_weight < 1)
    rows = (
        ("keyframe", log.keyframe, "#444444"),
        ("anchor", log.anchor >= 0, "#e07b00"),
        ("anchor gated", gated, "#b00020"),
        ("reset", log.reset, "#b00020"),
    )
    for level, (_, flags, color) in enumerate(rows):
        axis.vlines(t[flags], level + 0.1, level + 0.9, color=color, linewidth=1.0)
    axis.set_yticks([level + 0.5 for level in range(len(rows))], [row[0] for row in rows], fontsize=8)
    axis.set_ylim(0, len(rows))
    axis.set_xlabel("time (s)")
    present = sorted({state for state, _, _ in _spans(log)})
    handles = [Rectangle((0, 0), 1, 1, color=STATE_COLOR[state], alpha=0.5) for state in present]
    axis.legend(
        handles, [s.name for s in present], loc="upper center", bbox_to_anchor=(0.5, -0.55), ncols=4, fontsize=8
    )
