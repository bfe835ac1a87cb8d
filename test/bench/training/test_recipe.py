from pathlib import Path

import pytest

from hat_ros.bench.synth.models import model_names, write_model
from hat_ros.bench.training.recipe import FIRST_KEPT_SEED, Recipe
from hat_ros.errors import UsageError


def test_data_kept_aside_share_no_seed_and_no_craft_with_training():
    recipe = Recipe(generated=40, seed=3)
    training, kept = recipe.training, recipe.kept
    assert training.seed != kept.seed
    assert recipe.sample_seed != kept.seed
    seeds = [{source.seed for source in one.sources if source.kind == "generated"} for one in (training, kept)]
    assert len(seeds[0]) == 40
    assert len(seeds[1]) == 4
    assert not seeds[0] & seeds[1]


def test_data_kept_aside_are_the_same_for_every_seed():
    assert Recipe(seed=1).kept == Recipe(seed=2).kept
    assert Recipe(seed=1).training != Recipe(seed=2).training


def test_the_default_trains_on_what_a_clone_holds():
    sources = Recipe().training.sources
    assert [source.model for source in sources if source.kind == "model"] == model_names()
    assert {source.views for source in sources if source.kind == "model"} == {115}
    assert not [source for source in sources if source.kind == "cad"]


def test_cad_files_come_first_and_by_their_content(tmp_path):
    path = tmp_path / "own.glb"
    write_model("cubesat", path)
    told = Recipe((path,), generated=1).training.fingerprint()
    assert [(cad["file"], cad["views"]) for cad in told["cads"]] == [("own.glb", 246)]
    write_model("probe", path)
    assert Recipe((path,), generated=1).training.fingerprint()["cads"] != told["cads"]
    assert Recipe((path,), generated=1).training.sources[0].path == path


@pytest.mark.parametrize("numbers", [{"generated": FIRST_KEPT_SEED + 1}, {"seed": FIRST_KEPT_SEED}])
def test_seeds_of_data_kept_aside_are_refused(numbers):
    with pytest.raises(UsageError, match="kept aside"):
        Recipe(**numbers)


def test_kept_samples_grow_with_the_training():
    assert [Recipe(steps=steps).kept_samples for steps in (3, 100, 6000)] == [32, 100, 1024]


def test_a_missing_cad_is_named():
    with pytest.raises(Exception, match=r"nothing\.glb: no such file"):
        Recipe((Path("nothing.glb"),)).training.fingerprint()
