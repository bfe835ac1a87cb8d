"""Craft of a campaign, by name."""

import pytest

from hat_ros.bench.campaign.crafts import FIRST_SEED, crafts_named
from hat_ros.bench.synth.models import write_model
from hat_ros.errors import MeshError, UsageError


def test_files_come_first_and_names_are_unique(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_model("probe", tmp_path / folder / "probe.glb")
    crafts = crafts_named([tmp_path / "a" / "probe.glb", tmp_path / "b" / "probe.glb"], 2)
    assert [craft.name for craft in crafts] == ["probe", "probe-2", "generated-0", "generated-1"]
    assert [craft.seed for craft in crafts[2:]] == [FIRST_SEED, FIRST_SEED + 1]
    assert crafts[0].load() is crafts[0].load()
    assert crafts[2].load().sha256 != crafts[3].load().sha256


def test_units_of_a_target_file_hold(tmp_path):
    write_model("probe", tmp_path / "probe.glb")
    (tmp_path / "target.yaml").write_text("mesh: probe.glb\nunit_scale: 0.5\nname: half\n", encoding="utf-8")
    half, whole = crafts_named([tmp_path / "target.yaml", tmp_path / "probe.glb"], 0)
    assert half.name == "half"
    assert half.load().diameter_m == pytest.approx(0.5 * whole.load().diameter_m)
    assert half.model_file(tmp_path).unit_scale == 0.5


def test_what_cannot_be_used_is_refused_before_anything_runs(tmp_path):
    with pytest.raises(UsageError, match="no craft"):
        crafts_named([], 0)
    with pytest.raises(MeshError, match="no such file"):
        crafts_named([tmp_path / "none.glb"], 0)
