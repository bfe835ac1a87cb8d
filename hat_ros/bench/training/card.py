"""The model card of a trained segmentation network, as JSON, Markdown and a figure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from hat_ros.bench.evaluation.figures import image_bytes
from hat_ros.bench.evaluation.tables import Column, Table
from hat_ros.io.results import write_json

_COLOR = "#20406a"
_COLUMNS = (
    Column("size", "size"),
    Column("samples", "samples", "d"),
    Column("evidence", "image alone", ".3f"),
    Column("primed", "with a prior", "d"),
    Column("evidence_primed", "image alone, these", ".3f"),
    Column("tracked", "given the prior", ".3f"),
)
_LIMITS = (
    "It was trained on rendered images. Real cameras have faults that are not in the data.",
    "It knows craft of the kinds listed above. A target of another kind, such as a bare rock, may be taken for "
    "background.",
    "In one window it looks for one target. Another craft in the image counts as target as well.",
    "What is behind something in front of the target is trained to log-odds of 0: neither target nor background.",
    "Factor and offset of the calibration were fitted to the same samples that the curve comes from.",
)


def write_card(out: Path, card: dict[str, Any]) -> None:
    """Write ``card.json``, ``card.md``, ``calibration.png`` and ``calibration.svg`` into a folder."""
    write_json(out / "card.json", card)
    (out / "card.md").write_text(card_text(card), encoding="utf-8")
    for form in ("png", "svg"):
        (out / f"calibration.{form}").write_bytes(image_bytes(calibration_figure(card["calibration"]["curve"]), form))


def card_text(card: dict[str, Any]) -> str:
    """The card as Markdown."""
    parts = [
        "# Model card: segmentation network",
        _network(card["network"]),
        "## Trained on",
        _data(card["training_data"]),
        _rebuilding(card["training_data"]["cads"]),
        _training(card["training"]),
        "## Overlap on craft kept aside",
        "Never trained on: " + _data(card["kept_data"]),
        _overlaps(card["overlap"]),
        "## Calibration",
        _calibration(card["calibration"]),
        "![Share of target over the probability stated](calibration.png)",
        "## Limits",
        "\n".join(f"* {line}" for line in _LIMITS),
        "## Versions",
        "\n".join(f"* {name}: {version}" for name, version in card["versions"].items()),
    ]
    return "\n\n".join(parts) + "\n"


def _network(network: dict[str, Any]) -> str:
    return (
        "A U-Net of depthwise separable convolutions with one encoder and two decoders. It separates a spacecraft, "
        "whichever it is, from what is behind it.\n\n"
        f"* `{network['file']}`: {network['bytes'] / 1e6:.2f} MB, {network['parameters']:,} parameters, SHA-256 "
        f"`{network['sha256']}`\n"
        "* input `image`: (1, 4, H, W), red, green, blue and brightness on a logarithmic scale; H and W multiples of "
        "32\n"
        "* input `prior`: (1, 1, H / 2, W / 2), +0.5 inside an expected silhouette, -0.5 outside, 0 without one\n"
        "* output `evidence`: (1, 4, H / 2, W / 2), log-odds in nats of target against background, the four pixels of "
        "each cell; does not depend on `prior`\n"
        "* output `tracked`: likewise, given `prior`"
    )


def _data(data: dict[str, Any]) -> str:
    parts = []
    if data["cads"]:
        rows = [f"`{cad['file']}` (`{cad['sha256'][:12]}`, {cad['views']} views)" for cad in data["cads"]]
        parts.append("CAD files " + ", ".join(rows))
    if data["models"]:
        names = ", ".join(model["name"] for model in data["models"])
        parts.append(f"the package's own models {names} ({data['models'][0]['views']} views each)")
    generated = data["generated"]
    if generated["seeds"]:
        seeds = generated["seeds"]
        parts.append(f"{len(seeds)} generated craft, seeds {seeds[0]} to {seeds[-1]} ({generated['views']} views)")
    parts.append(f"{data['backgrounds']} backgrounds")
    return "; ".join(parts) + f". Seed of views and backgrounds {data['seed']}."


def _rebuilding(cads: Sequence[dict[str, Any]]) -> str:
    if not cads:
        return "All of this is rendered by the package itself: a clone of it rebuilds these data."
    return (
        "A clone of the package rebuilds the backgrounds, the generated craft and its own models. The CAD files are "
        "not in it: give them with `--cad`, in this order."
    )


def _training(training: dict[str, Any]) -> str:
    processor = f"threads: {training['threads']}, processes that composed samples beside: {training['workers']}"
    return (
        f"{training['steps']} steps of {training['batch']} samples, the first {training['coarse_share']:.0%} of them "
        f"with sides of {training['coarse_px']} pixels, the others of {training['side_px']}; composition seed "
        f"{training['sample_seed']}, seed of the weights {training['seed']}. {training['seconds'] / 60:.1f} minutes "
        f"({processor}). Mean loss of the last steps {training['loss']:.3f}."
    )


def overlap_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Mean overlap of masks on craft kept aside, from the card's rows."""
    title = "Overlap (intersection over union) of masks on craft kept aside"
    return Table(title, _COLUMNS, [row | {"size": _span(row)} for row in rows])


def _overlaps(rows: Sequence[dict[str, Any]]) -> str:
    note = (
        "Mean intersection over union of mask (log-odds above 0) and truth. Size: square root of the target's area, "
        "pixels at the network's scale. Of the priors 55 % are nearly right; the others are other poses of the craft, "
        "masks with faults, or lie elsewhere."
    )
    lines = [note, "", _line(column.title for column in _COLUMNS), "|---" * len(_COLUMNS) + "|"]
    lines += [_line(column.text(row) for column in _COLUMNS) for row in overlap_table(rows).rows]
    return "\n".join(lines)


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _span(row: dict[str, Any]) -> str:
    if row["high_px"] == float("inf"):
        return f"{row['low_px']:.0f} px and more" if row["low_px"] else "all"
    return f"{row['low_px']:.0f} to {row['high_px']:.0f} px"


def _calibration(calibration: dict[str, Any]) -> str:
    scales, offsets = calibration["scales"], calibration["offsets"]
    last = calibration["curve"][-1]
    lines = [
        f"Log-odds are multiplied by {scales[0]:.3f} and shifted by {offsets[0]:.3f} nats (image alone), by "
        f"{scales[1]:.3f} and {offsets[1]:.3f} (given a prior); both are part of the file.",
        "",
        f"Of the pixels said to be target at 90 % and more (on average {_number(last['stated'], '.1%')}), "
        f"{_number(last['target'], '.1%')} are.",
        "",
        "| stated | on average | are target | pixels |",
        "|---|---|---|---|",
    ]
    for row in calibration["curve"]:
        stated, target = _number(row["stated"], ".1%"), _number(row["target"], ".1%")
        lines.append(_line((f"{row['from']:.0%} to {row['to']:.0%}", stated, target, str(row["pixels"]))))
    return "\n".join(lines)


def _number(value: float, form: str = ".3f") -> str:
    return "-" if value != value else format(value, form)


def calibration_figure(curve: Sequence[dict[str, Any]]) -> Figure:
    """Share of pixels that are target over the probability stated, with the line on which both agree."""
    figure, axis = plt.subplots(figsize=(4.2, 4.0), layout="constrained")
    axis.plot([0, 100], [0, 100], color="#999999", linewidth=1, linestyle="--")
    rows = [row for row in curve if row["pixels"]]
    stated, target = ([100 * row[key] for row in rows] for key in ("stated", "target"))
    axis.plot(stated, target, "o-", color=_COLOR, markersize=5, linewidth=1.2)
    axis.set_xlim(0, 100)
    axis.set_ylim(0, 100)
    axis.set_aspect("equal")
    axis.grid(True, alpha=0.3)
    axis.set_xlabel("probability of target stated, %", fontsize=9)
    axis.set_ylabel("pixels that are target, %", fontsize=9)
    axis.spines[["top", "right"]].set_visible(False)
    return figure
