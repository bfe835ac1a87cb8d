"""``report.html``: one file with plots, overlay frames and tables embedded; opens without a network."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.bench.evaluation import figures
from hat_ros.geometry.symmetry import known_up_to
from hat_ros.io.run_log import RunLog
from hat_ros.types import StateReason, TrackState

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1080px; margin: 2em auto; padding: 0 1em; color: #1c2733; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 1.8em; }
table { border-collapse: collapse; } td, th { padding: .25em .8em; border-bottom: 1px solid #dde3ea; text-align: left; }
td.n { text-align: right; font-variant-numeric: tabular-nums; }
img { max-width: 100%; } .strip { display: grid; grid-template-columns: repeat(4, 1fr); gap: 4px; }
pre { background: #f4f6f8; padding: .8em; overflow-x: auto; font-size: .85em; } .note { color: #5b6b7b; }
"""

# metrics.json name, what people read, format, factor.
_FIGURES = (
    ("frames", "frames of the recording", "d"),
    ("refused", "frames refused", "d"),
    ("dropped", "frames dropped", "d"),
    ("valid", "frames with a pose", "d"),
    ("coverage", "coverage", ".1%"),
    ("E_p_mean", "E_p mean", ".4f"),
    ("E_p_sd", "E_p SD", ".4f"),
    ("E_t_m_mean", "E_t mean (m)", ".4f"),
    ("E_t_m_sd", "E_t SD (m)", ".4f"),
    ("E_q_deg_mean", "E_q mean (deg)", ".3f"),
    ("E_q_deg_sd", "E_q SD (deg)", ".3f"),
    ("E_q_over_90_share", "E_q beyond 90 deg", ".1%"),
    ("E_p_sym_mean", "E_p to the nearest equal orientation, mean", ".4f"),
    ("E_q_sym_deg_mean", "E_q to the nearest equal orientation, mean (deg)", ".3f"),
    ("ADD_S_m_mean", "ADD-S mean (m)", ".4f"),
    ("MSSD_m_mean", "MSSD mean (m)", ".4f"),
    ("MSPD_px_mean", "MSPD mean (px)", ".2f"),
    ("AR_MSSD", "BOP recall by MSSD", ".3f"),
    ("AR_MSPD", "BOP recall by MSPD", ".3f"),
    ("keyframes", "keyframes", "d"),
    ("oracle_within_15_share", "best candidate within 15 deg", ".1%"),
    ("oracle_within_30_share", "best candidate within 30 deg", ".1%"),
    ("mask_iou_mean", "mask overlap, mean", ".3f"),
    ("relative_motion_deg_median", "relative rotation error per frame, median (deg)", ".3f"),
    ("inside_95_share", "ground truth inside the 95 % ellipsoid", ".1%"),
    ("untrue_tracking_share", "frames beyond 30 deg called TRACKING", ".1%"),
    ("resets", "alignment resets", "d"),
    ("fps", "frames per second", ".1f"),
    ("latency_ms_p50", "latency p50 (ms)", ".1f"),
    ("latency_ms_p99", "latency p99 (ms)", ".1f"),
    ("peak_memory_mib", "peak memory (MiB)", ".0f"),
)


def write_report(
    path: Path,
    title: str,
    log: RunLog,
    metrics: dict[str, Any],
    run: dict[str, Any],
    config_text: str,
    strip: Sequence[tuple[str, UInt8]] = (),
) -> None:
    """Write the report of one run.

    Args:
        path: the HTML file.
        title: heading.
        log: the run.
        metrics: contents of ``metrics.json``.
        run: contents of ``run.json``.
        config_text: the configuration as used, YAML.
        strip: captioned overlay frames, RGB.
    """
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        _figure_table(metrics),
        _symmetry(metrics),
        _states(log),
        _refusals(metrics.get("refused_reasons", ())),
        "<h2>Over time</h2>",
        image(figures.image_bytes(figures.error_figure(log)), "errors over time"),
        '<p class="note">Background: state of the output. Crosses: best of the K candidates at keyframes; dots: the '
        "anchor that was chosen; dashed red: alignment dropped. Frames without a pose have no error and lower the "
        "coverage.</p>",
    ]
    if strip:
        parts += ["<h2>Overlay</h2>", _strip(strip)]
    if metrics.get("range_bins"):
        parts += [
            "<h2>By range</h2>",
            image(figures.image_bytes(figures.range_figure(metrics["range_bins"])), "by range"),
        ]
    parts += [
        "<h2>Where it comes from</h2>",
        f"<pre>{html.escape(json.dumps(run, indent=2))}</pre>",
        "<details><summary>Configuration as used</summary>",
        f"<pre>{html.escape(config_text)}</pre></details>",
    ]
    path.write_text(page(title, parts), encoding="utf-8")


def page(title: str, parts: Sequence[str]) -> str:
    """A whole HTML page from the pieces of its body."""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def image(data: bytes, description: str, kind: str = "png") -> str:
    """An image of this kind as an element of a page, its bytes embedded."""
    return f'<img alt="{html.escape(description)}" src="data:image/{kind};base64,{base64.b64encode(data).decode()}">'


def _figure_table(metrics: dict[str, Any]) -> str:
    rows = []
    for key, label, form in _FIGURES:
        value = metrics.get(key)
        if value is not None and np.isfinite(value):
            rows.append(f'<tr><td>{label}</td><td class="n">{value:{form}}</td></tr>')
    return f"<table>{''.join(rows)}</table>"


def _symmetry(metrics: dict[str, Any]) -> str:
    """How far poses of the target are known; nothing without a symmetry."""
    words = known_up_to(metrics.get("symmetry_order", 1), metrics.get("symmetry_free_axes", 0))
    note = "Errors over time, states, covariance and hypotheses are held against the equal orientation that is nearest."
    return f'<p class="note">The target is symmetric: a pose is {words}. {note}</p>' if words else ""


def _states(log: RunLog) -> str:
    """How many frames had which state, and why."""
    pairs, counts = np.unique(np.stack([log.state, log.reason]), axis=1, return_counts=True)
    rows = []
    for i in np.argsort(-counts, kind="stable"):
        state, reason = TrackState(int(pairs[0, i])), StateReason(int(pairs[1, i]))
        rows.append(f'<tr><td class="n">{counts[i]}</td><td>{state.name}</td><td>{reason.words}</td></tr>')
    return f"<h2>States</h2><table>{''.join(rows)}</table>" if rows else ""


def _refusals(reasons: Sequence[dict[str, Any]]) -> str:
    """Why frames were refused: the number of cases and the first of each reason; empty where none was."""
    rows = [
        f'<tr><td class="n">{int(reason["count"])}</td><td>{html.escape(reason["first"])}</td></tr>'
        for reason in reasons
    ]
    return f"<h2>Frames refused</h2><table>{''.join(rows)}</table>" if rows else ""


def _strip(frames: Sequence[tuple[str, UInt8]]) -> str:
    cells = []
    for caption, rgb in frames:
        ok, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 82])
        if ok:
            cells.append(
                f"<figure style='margin:0'>{image(data.tobytes(), caption, 'jpeg')}"
                f"<figcaption class='note'>{html.escape(caption)}</figcaption></figure>"
            )
    return f'<div class="strip">{"".join(cells)}</div>'
