"""What a campaign's folder holds beside the clips: tables, figures, report."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path

from hat_ros.bench.campaign.figure import map_figure, strata_figure
from hat_ros.bench.campaign.map import map_table
from hat_ros.bench.campaign.report import clips_table, numbers_table, shown_clips, shown_table, strata_rows
from hat_ros.bench.campaign.run import Result
from hat_ros.bench.evaluation.figures import image_bytes
from hat_ros.bench.evaluation.report import image, page
from hat_ros.io.results import RUN_FILE

_NOTE = (
    "found: mean E_p below 0.1 with a pose on 90 % of the frames. right: E_p below 0.05. wrong: above 0.1. far: beyond "
    "30 degrees or above 0.6. In brackets 95 % intervals: Wilson for clips, bootstrap over clips for the others. Every "
    "computed pose counts, whatever is published. A missing mask has an overlap of 0; frames count where the craft "
    "spans 30 pixels."
)


def write_folder(out: Path, results: Sequence[Result]) -> str:
    """Write tables, figures and report.

    Args:
        out: the campaign's folder, with the ``run.json`` that says where the results come from.
        results: of all clips.

    Returns:
        The tables as text.
    """
    told = json.loads((out / RUN_FILE).read_text(encoding="utf-8")) if (out / RUN_FILE).is_file() else {}
    rows = strata_rows(results)
    shown, numbers = shown_table("campaign", rows), numbers_table("campaign", rows)
    text = shown.text()
    pictures = {"campaign": strata_figure(rows)}
    placed = map_table(results)
    if placed.rows:
        placed.write(out, "map")
        text += "\n" + placed.text()
        pictures["map"] = map_figure(placed.rows)
    (out / "campaign.txt").write_text(text, encoding="utf-8")
    (out / "campaign.csv").write_text(numbers.csv(), encoding="utf-8")
    (out / "campaign.tex").write_text(shown.latex(), encoding="utf-8")
    clips = clips_table(results)
    (out / "by_clip.csv").write_text(clips.csv(), encoding="utf-8")
    record = {"run": told, "strata": json.loads(numbers.json())["rows"], "clips": json.loads(clips.json())["rows"]}
    (out / "campaign.json").write_text(json.dumps(record, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    parts = ["<h1>Campaign</h1>", f'<p class="note">{html.escape(_NOTE)}</p>', f"<pre>{html.escape(text)}</pre>"]
    for name, figure in pictures.items():
        (out / f"{name}.svg").write_bytes(image_bytes(figure, "svg"))
        png = image_bytes(figure, "png")
        (out / f"{name}.png").write_bytes(png)
        parts.append(image(png, name))
    parts += ["<h2>Clip by clip</h2>", f"<pre>{html.escape(shown_clips(results).text())}</pre>"]
    parts += ["<h2>Where it comes from</h2>", f"<pre>{html.escape(json.dumps(told, indent=2))}</pre>"]
    (out / "report.html").write_text(page("Campaign", parts), encoding="utf-8")
    return text
