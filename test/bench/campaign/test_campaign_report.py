"""Tables of a campaign: who belongs to a stratum, what is summed, what people read."""

import csv
import io
import json

import numpy as np
import pytest
from campaign_results import failed, result

from hat_ros.bench.campaign.intervals import wilson
from hat_ros.bench.campaign.report import (
    clips_table,
    described,
    numbers_table,
    shown_clips,
    shown_table,
    strata,
    strata_rows,
    summary,
)

RESULTS = [result(index, found=index % 3 == 0) for index in range(30)]


def test_every_factor_parts_all_clips():
    groups = strata(RESULTS)
    for factor in ("all", "background", "size px", "phase deg", "rate deg/frame", "mismatch", "craft"):
        members = [r.index for name, _, group in groups if name == factor for r in group]
        assert sorted(members) == list(range(30)), factor
    by_name = {(factor, name): group for factor, name, group in groups}
    assert len(by_name["sensor", "grey"]) + len(by_name["sensor", "colour"]) == 30
    both = by_name["sensor", "grey before earth"]
    assert both
    assert all(r.factors["grey"] and r.factors["background"] == "earth" for r in both)


def test_sizes_are_terciles():
    counts = [len(group) for factor, _, group in strata(RESULTS) if factor == "size px"]
    assert counts == [10, 10, 10]


def test_strata_without_clips_are_left_out():
    names = [name for _, name, _ in strata([result(0)])]
    assert "earth" in names
    assert "sky" not in names


def test_failed_clips_count_as_not_found():
    row = summary([result(0, found=True), failed(1, "MeshError: gone")])
    assert (row["clips"], row["failed"], row["found_clips"], row["found"]) == (2, 1, 1, 0.5)
    assert (row["found_low"], row["found_high"]) == wilson(1, 2)
    assert row["mask_iou"] == 0


def test_shares_are_of_all_frames():
    row = summary([result(0, tracking=30, tracking_wrong=3), result(1, tracking=10, tracking_wrong=5)])
    assert row["tracking_wrong"] == 0.2
    assert row["tracking_wrong_low"] <= 0.2 <= row["tracking_wrong_high"]
    assert np.isnan(summary([result(0)])["tracking_wrong"])


def test_times_are_of_all_frames():
    row = summary([result(0), result(10)])
    assert (row["segmentation_ms"], row["frame_ms"]) == (5, 20)
    assert row["segmentation_ms_p99"] == 10
    assert "segmentation_ms" not in summary([failed(0, "gone")])


def test_a_median_that_is_never_reached_is_said():
    rows = strata_rows([result(0, found=True), result(1), result(2)])
    assert rows[0]["first_right"] == np.inf
    text = shown_table("campaign", rows).text()
    assert "never (3-never)" in text
    assert "33 (6-79)" in text
    assert json.loads(numbers_table("campaign", rows).json())["rows"][0]["first_right"] is None


def test_clips_are_listed_in_full():
    lines = list(csv.DictReader(io.StringIO(clips_table([result(0, found=True), failed(1, "gone")]).csv())))
    assert [line["found"] for line in lines] == ["True", "False"]
    assert lines[1]["failure"] == "gone"
    assert float(lines[0]["phase_deg"]) == pytest.approx(RESULTS[0].factors["phase_deg"])
    text = shown_clips([result(0, found=True), failed(1, "gone"), result(2)]).text()
    assert [word for word in text.split() if word in ("found", "gone", "lost")] == ["found", "found", "gone", "lost"]


def test_a_clip_in_one_line():
    assert described(result(0)).startswith("000000 ")
    assert " earth, grey, " in described(result(0))
