"""The map: its places, its table, its figure."""

import pytest
from campaign_results import result

from hat_ros.bench.campaign.figure import map_figure
from hat_ros.bench.campaign.map import map_cells, map_table

CELLS = map_cells()


def test_places_are_different_and_the_sun_is_seen():
    assert len(set(CELLS)) == len(CELLS) == 44
    assert all(cell.phase_deg[1] <= 135 for cell in CELLS if cell.background == "earth")


def test_a_row_per_place():
    rows = map_table([result(index, found=index < 44, on_map=True) for index in range(88)]).rows
    assert len(rows) == 44
    assert {(row["clips"], row["found"]) for row in rows} == {(2, 0.5)}
    assert rows[0]["found_low"] == pytest.approx(0.0945, abs=1e-4)


def test_ranges_are_told_for_a_single_craft():
    alone = map_table([result(index, on_map=True, crafts=("probe",)) for index in range(3)]).rows[0]
    # 3 m across at a focal length of 1000 px.
    assert alone["range_low_m"] == pytest.approx(3000 / alone["size_high_px"])
    assert alone["range_high_m"] == pytest.approx(3000 / alone["size_low_px"])
    several = map_table([result(index, on_map=True) for index in range(3)])
    assert "range" not in several.text()


def test_clips_drawn_freely_are_on_no_map():
    assert not map_table([result(0)]).rows


def test_figure():
    rows = map_table([result(index, found=index % 2 == 0, on_map=True, crafts=("probe",)) for index in range(44)]).rows
    figure = map_figure(rows)
    panels = figure.axes[:3]
    assert [panel.get_title() for panel in panels] == ["black sky", "before the Earth", "before the limb"]
    assert len(panels[0].texts) == 16
    assert len(panels[1].texts) == 12  # no sun behind an Earth that fills the image
    assert "m" in panels[0].get_xticklabels()[0].get_text()
    assert figure.axes[0].collections[0].get_array()[0, 0] == 1
