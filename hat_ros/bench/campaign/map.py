"""The map of where it will work: size in the image x phase angle, a panel per background."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from hat_ros.bench.campaign.draw import BACKGROUNDS, Cell
from hat_ros.bench.campaign.intervals import wilson
from hat_ros.bench.campaign.report import summary
from hat_ros.bench.campaign.run import Result
from hat_ros.bench.evaluation.tables import Column, Table

_SIZES_PX = (30.0, 60.0, 110.0, 200.0, 360.0)
_PHASES_DEG = (0.0, 45.0, 90.0, 135.0, 180.0)
# Beyond, an Earth that fills the image hides the sun.
_EARTH_PHASE_DEG = 135.0
CLIPS_PER_CELL = 3


def map_cells() -> list[Cell]:
    """All places of the map, in the order in which clips are dealt to them."""
    return [
        Cell(background, size, phase)
        for background in BACKGROUNDS
        for size in pairwise(_SIZES_PX)
        for phase in pairwise(_PHASES_DEG)
        if background != "earth" or phase[1] <= _EARTH_PHASE_DEG
    ]


def map_table(results: Sequence[Result]) -> Table:
    """Where it will work: a row per cell of the map; ranges in metres where all clips show one craft."""
    cells: dict[tuple[Any, ...], list[Result]] = {}
    for result in results:
        if result.cell is not None:
            key = (result.cell["background"], *result.cell["size_px"], *result.cell["phase_deg"])
            cells.setdefault(key, []).append(result)
    reach = _reach_px_m(results)
    rows = []
    for (background, *bounds), members in cells.items():
        row = {"background": background} | dict(zip(_BOUNDS, bounds, strict=True))
        if reach is not None:
            row |= {"range_low_m": reach / row["size_high_px"], "range_high_m": reach / row["size_low_px"]}
        found = sum(bool(result.figures["found"]) for result in members)
        low, high = wilson(found, len(members))
        row |= {"clips": len(members), "found_clips": found, "found": found / len(members)}
        rows.append(row | {"found_low": low, "found_high": high, "first_right": summary(members)["first_right"]})
    columns = [column for column in _COLUMNS if reach is not None or not column.key.startswith("range")]
    return Table("map: share of clips found", columns, rows)


def _reach_px_m(results: Sequence[Result]) -> float | None:
    """Size in pixels times range in metres, the same in all clips of one craft; None with several craft."""
    products = [
        result.factors["range_first_m"] * result.factors["size_first_px"]
        for result in results
        if result.factors["range_first_m"] is not None
    ]
    several = len({result.factors["craft"] for result in results}) > 1
    return None if several or not products else float(products[0])


_BOUNDS = ("size_low_px", "size_high_px", "phase_low_deg", "phase_high_deg")
_COLUMNS = (
    Column("background", "background"),
    Column("size_low_px", "px from", ".0f"),
    Column("size_high_px", "to", ".0f"),
    Column("range_low_m", "range m from", ".3g"),
    Column("range_high_m", "to", ".3g"),
    Column("phase_low_deg", "phase from", ".0f"),
    Column("phase_high_deg", "to", ".0f"),
    Column("clips", "clips", "d"),
    Column("found", "found", ".0%"),
    Column("found_low", "low", ".0%"),
    Column("found_high", "high", ".0%"),
    Column("first_right", "frames to right", ".0f"),
)
