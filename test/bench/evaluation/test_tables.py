"""One table in four notations."""

import json

import pytest

from hat_ros.bench.evaluation.tables import Column, Table

TABLE = Table(
    "Results",
    (Column("clip", "clip"), Column("E_p_mean", "E_p", ".3f", "$E_p$"), Column("share", ">90", ".1%")),
    [{"clip": "a_b", "E_p_mean": 0.12345, "share": 0.5}, {"clip": "c", "E_p_mean": None, "share": float("nan")}],
)


def test_text_is_aligned_and_missing_figures_are_dashes():
    lines = TABLE.text().splitlines()
    assert lines[0] == "Results"
    assert lines[3].split() == ["a_b", "0.123", "50.0%"]
    assert lines[4].split() == ["c", "-", "-"]


def test_csv_and_json_keep_full_precision():
    assert TABLE.csv().splitlines()[1] == "a_b,0.12345,0.5"
    rows = json.loads(TABLE.json(), parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))["rows"]
    assert (rows[0]["E_p_mean"], rows[1]["share"]) == (0.12345, None)


def test_latex_escapes_text_but_not_headings():
    text = TABLE.latex()
    assert r"a\_b & 0.123 & 50.0\% \\" in text
    assert "$E_p$" in text
    assert "$>$90" in text, "in text, the default fonts of LaTeX print > as another character"


def test_same_figures_same_bytes(tmp_path):
    TABLE.write(tmp_path, "one")
    TABLE.write(tmp_path, "two")
    for suffix in ("txt", "csv", "tex", "json"):
        assert (tmp_path / f"one.{suffix}").read_bytes() == (tmp_path / f"two.{suffix}").read_bytes()
