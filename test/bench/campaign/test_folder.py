"""The files of a campaign."""

import csv
import json

import cv2
import numpy as np
import pytest
from campaign_results import failed, result

from hat_ros.bench.campaign.figure import strata_figure
from hat_ros.bench.campaign.folder import write_folder
from hat_ros.bench.campaign.report import strata_rows


@pytest.mark.parametrize("on_map", [False, True])
def test_files(tmp_path, on_map):
    (tmp_path / "run.json").write_text('{"seed": 5}', encoding="utf-8")
    results = [result(0, found=True, on_map=on_map), failed(1, "MeshError: <gone>")]
    text = write_folder(tmp_path, results)
    assert (tmp_path / "campaign.txt").read_text(encoding="utf-8") == text
    record = json.loads((tmp_path / "campaign.json").read_text(encoding="utf-8"))
    assert record["run"] == {"seed": 5}
    assert [clip["found"] for clip in record["clips"]] == [True, False]
    with (tmp_path / "campaign.csv").open(encoding="utf-8") as file:
        first = next(csv.DictReader(file))
    assert (first["stratum"], first["found"]) == ("all", "0.5")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "MeshError: &lt;gone&gt;" in page
    assert page.count("<img ") == 1 + on_map
    for name in ("campaign", *(["map"] if on_map else [])):
        assert np.ptp(cv2.imread(str(tmp_path / f"{name}.png"))) > 100
        assert "<svg" in (tmp_path / f"{name}.svg").read_text(encoding="utf-8")
    assert (tmp_path / "map.csv").exists() is on_map


def test_the_same_results_give_the_same_bytes(tmp_path):
    results = [result(index, found=index % 2 == 0) for index in range(6)]
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_folder(tmp_path / name, results)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_figure_has_a_line_per_stratum():
    rows = strata_rows([result(index, found=index % 2 == 0) for index in range(12)])
    axis = strata_figure(rows).axes[0]
    labels = [label.get_text() for label in axis.get_yticklabels()]
    assert labels[:2] == ["all", "sky"]
    assert "mismatch: none" in labels
    assert axis.lines[0].get_xdata()[0] == 50
