import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")
pytest.importorskip("onnx", reason="the extra 'train' is not installed")

from hat_ros.bench.training import fit  # noqa: E402
from hat_ros.bench.training import recipe as recipes  # noqa: E402
from hat_ros.bench.training import train as module  # noqa: E402
from hat_ros.bench.training.data import prepare  # noqa: E402
from hat_ros.bench.training.model import Segmenter, joined  # noqa: E402
from hat_ros.bench.training.recipe import Recipe  # noqa: E402
from hat_ros.bench.training.samples import Composer  # noqa: E402
from hat_ros.bench.training.train import train  # noqa: E402
from hat_ros.errors import UsageError  # noqa: E402
from hat_ros.segmentation.network import SegmentationNetwork, network_input  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_thread")
RECIPE = Recipe(generated=2, views=2, backgrounds=2, steps=3)


def silent(name, done, total):
    pass


@pytest.fixture(scope="module")
def trained(tmp_path_factory, one_thread):
    """A training of three steps of four samples."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit.Settings, "__init__", _few(fit.Settings.__init__))
        patch.setattr(recipes, "model_names", lambda: ["cubesat"])
        patch.setattr(recipes, "_MODEL_VIEWS", 1.0)
        patch.setattr(recipes, "_MIN_KEPT_SAMPLES", 8)
        patch.setattr(module, "_COARSE_PX", 64)
        patch.setattr(module, "_SIDE_PX", 96)
        out = tmp_path_factory.mktemp("trained") / "out"
        card = train(RECIPE, out, silent)
        yield out, card


def _few(init):
    def few(self, **told):
        init(self, **told, batch=4, workers=0)

    return few


def test_the_exported_network_is_the_trained_and_calibrated_one(trained):
    out, card = trained
    kept = torch.load(out / "checkpoint.pt", weights_only=True)
    model = Segmenter()
    model.load_state_dict(kept["model"])
    model.eval()
    data = prepare(RECIPE.kept, out / "data" / "kept", "kept aside", silent)
    sample = Composer(data.views, data.backgrounds, 1, 96).sample(0)
    rng = np.random.default_rng(0)
    cells = rng.random((48, 48), np.float32)
    with torch.no_grad():
        prior = torch.from_numpy(cells - np.float32(0.5))[None, None]
        outputs = model(torch.from_numpy(network_input(sample.rgb)), prior)
    found = SegmentationNetwork(out / "segmenter.onnx").with_prior(sample.rgb, cells)
    calibration = card["calibration"]
    for log_odds, raw, scale, offset in zip(found, outputs, calibration["scales"], calibration["offsets"], strict=True):
        np.testing.assert_allclose(log_odds, scale * joined(raw)[0].numpy() + offset, atol=1e-4)


def test_the_card_says_what_it_is_made_of(trained):
    out, card = trained
    assert json.loads((out / "card.json").read_text())["training_data"] == card["training_data"]
    assert card["training"]["steps"] == 3
    assert card["training"]["loss"] > 0
    assert card["network"]["bytes"] == (out / "segmenter.onnx").stat().st_size < 4e6
    assert card["overlap"][0]["samples"] == sum(row["samples"] for row in card["overlap"][1:])
    assert card["kept_data"]["generated"]["seeds"] == [500_000]
    text = (out / "card.md").read_text()
    for words in (
        "a clone of it rebuilds",
        "2 generated craft, seeds 0 to 1",
        "Never trained on: 1 generated",
        "Limits",
    ):
        assert words in text
    assert (out / "calibration.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (out / "calibration.svg").read_bytes()


def test_the_same_command_uses_what_is_done(trained):
    out, card = trained
    before = (out / "data" / "training" / "backgrounds.npy").stat().st_mtime_ns
    told = []
    again = train(RECIPE, out, lambda name, done, total: told.append(name))
    assert (out / "data" / "training" / "backgrounds.npy").stat().st_mtime_ns == before
    assert "steps" not in told
    for part in ("network", "overlap", "calibration", "training"):
        assert repr(again[part]) == repr(card[part])


@pytest.mark.parametrize(
    ("other", "named"),
    [
        (Recipe(generated=3, views=2, backgrounds=2, steps=3), "training_data.generated.seeds"),
        (Recipe(generated=2, views=2, backgrounds=2, steps=4), "training.steps"),
    ],
)
def test_another_recipe_is_refused(other, named, trained):
    with pytest.raises(UsageError, match=f"by another recipe .*{named}"):
        train(other, trained[0], silent)
