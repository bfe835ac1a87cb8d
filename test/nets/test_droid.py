"""DROID's networks against the recorded answers of the public implementation with rule weights."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rule_weights import save_rule_weights
from weight_rule import rule_filled, rule_state

from hat_ros.errors import FrameError, WeightsError
from hat_ros.nets import checkpoint
from hat_ros.nets.droid import CORRELATION_LEVELS, DroidNet, upsample_disparity
from hat_ros.nets.droid_geometry import pixel_grid

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small tensors gain nothing from a second thread, and two of them spin when the machine is busy."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


TOLERANCE = 2e-5


@pytest.fixture(scope="module")
def net():
    return rule_filled(DroidNet()).requires_grad_(False)


@pytest.fixture(scope="module")
def features():
    return np.load(DATA / "droid_features.npz")


@pytest.fixture(scope="module")
def update():
    return np.load(DATA / "droid_update.npz")


@pytest.fixture(scope="module")
def encoded(net, features):
    images = torch.from_numpy(features["images_bgr_u8"])
    return net.features(images), *net.context(images)


def close(actual, expected, tolerance=TOLERANCE):
    expected = torch.as_tensor(expected)
    assert actual.shape == expected.shape
    worst = float((actual - expected).abs().max())
    assert worst <= tolerance * max(1.0, float(expected.abs().max())), worst


def test_every_tensor_has_the_published_name_and_shape(net, features):
    published = {name: tuple(shape) for name, shape in json.loads(str(features["tensors_json"])).items()}
    assert len(published) == 102
    assert {name: tuple(value.shape) for name, value in net.state_dict().items()} == published
    assert sum(value.numel() for value in net.state_dict().values()) == 4_002_565


def test_encoders_answer_as_published(features, encoded):
    for name, value in zip(("fmaps", "net", "inp"), encoded, strict=True):
        close(value[:, ::8], features[f"{name}_every8"])


@pytest.mark.parametrize("encoder", ["fnet", "cnet"])
def test_every_layer_of_the_encoders(net, features, encoder):
    seen = {}
    layers = ("conv1", "norm1", "layer1", "layer2", "layer3", "conv2")
    hooks = [
        getattr(getattr(net, encoder), layer).register_forward_hook(
            lambda _m, _i, out, layer=layer: seen.update({layer: out[0]})
        )
        for layer in layers
    ]
    images = torch.from_numpy(features["images_bgr_u8"][:1])
    net.features(images) if encoder == "fnet" else net.context(images)
    for hook in hooks:
        hook.remove()
    for layer in layers:
        # Instance normalisation sees one image at a time, so one image is enough.
        close(seen[layer][:2], features[f"tap/{encoder}.{layer}"])
        close(seen[layer].mean((1, 2)), features[f"tapmean/{encoder}.{layer}"])
        close(seen[layer].std((1, 2)), features[f"tapstd/{encoder}.{layer}"])


@pytest.mark.parametrize("stored", [True, False])
def test_correlation_and_lookup(net, encoded, update, stored):
    ii, jj = update["ii"], update["jj"]
    correlation = net.correlation(encoded[0][ii], encoded[0][jj], stored)
    for level, volume in enumerate(correlation.levels()):
        close(volume[0][::5, ::5], update[f"corr_level{level}_edge0_rows"])
    lookup = correlation.lookup(torch.from_numpy(update["coords1"][0]))
    close(lookup.mean((2, 3)), update["corr_lookup_mean"][0])
    for edge in (0, 3):
        close(lookup[edge][:, ::4], update[f"corr_lookup_edge{edge}_rows"])


def test_update_operator_answers_as_published(net, encoded, update):
    fmaps, hidden, inp = encoded
    ii = torch.from_numpy(update["ii"])
    lookup = net.correlation(fmaps[ii], fmaps[update["jj"]]).lookup(torch.from_numpy(update["coords1"][0]))
    motion = torch.from_numpy(update["motion"][0])
    close(net.update.corr_encoder(lookup).mean((2, 3)), update["corr_encoder_mean"])
    close(net.update.flow_encoder(motion).mean((2, 3)), update["flow_encoder_mean"])
    after, delta, weight = net.refine(hidden[ii], inp[ii], lookup, motion)
    close(after[:2, ::8], update["out_net_every8"])
    close(delta, update["out_delta"][0])
    close(weight, update["out_weight"][0])
    close(net.damping(after, ii, 3), update["out_eta"][0])
    mask = net.upsampling_mask(after, ii, 3)
    close(mask.mean((2, 3)), update["out_upmask_mean"][0])
    close(mask[0, ::4, ::4], update["out_upmask_rows"])
    close(upsample_disparity(torch.from_numpy(update["disps"][0]), mask)[:, ::3, ::3], update["disps_up_every3"])


def test_motion_filter_call_without_flow(net, encoded, update):
    fmaps, hidden, inp = encoded
    lookup = net.correlation(fmaps[:1], fmaps[1:2]).lookup(pixel_grid(16, 20)[None])
    _, delta, weight = net.refine(hidden[:1], inp[:1], lookup, None)
    close(delta, update["mf_delta"][0])
    close(weight, update["mf_weight"][0])
    assert float(delta.norm(dim=-1).mean()) == pytest.approx(float(update["mf_score"]), abs=1e-6)


def test_motion_is_clamped(net, encoded):
    fmaps, hidden, inp = encoded
    lookup = net.correlation(fmaps[:1], fmaps[1:2]).lookup(pixel_grid(16, 20)[None])
    far, edge = (torch.full((1, 4, 16, 20), value) for value in (1e4, 64.0))
    assert torch.equal(
        net.refine(hidden[:1], inp[:1], lookup, far)[1], net.refine(hidden[:1], inp[:1], lookup, edge)[1]
    )


@pytest.mark.parametrize("stored", [True, False])
def test_select_and_append_are_per_edge(net, encoded, stored):
    fmaps = encoded[0]
    coords = pixel_grid(16, 20).repeat(6, 1, 1, 1) + torch.arange(6.0).view(6, 1, 1, 1)
    ii, jj = torch.tensor([0, 1, 2, 0, 1, 2]), torch.tensor([1, 2, 0, 2, 0, 1])
    whole = net.correlation(fmaps[ii], fmaps[jj], stored)
    parts = net.correlation(fmaps[ii[:2]], fmaps[jj[:2]], stored)
    parts.append(net.correlation(fmaps[ii[2:]], fmaps[jj[2:]], stored))
    assert len(parts) == 6
    assert torch.allclose(whole.lookup(coords), parts.lookup(coords), atol=1e-5)
    keep = torch.tensor([4, 1])
    parts.select(keep)
    assert len(parts) == 2
    assert torch.allclose(whole.lookup(coords)[keep], parts.lookup(coords[keep]), atol=1e-5)


def test_lookup_outside_the_image_is_zero(net, encoded):
    fmaps = encoded[0]
    correlation = net.correlation(fmaps[:1], fmaps[1:2])
    for offset in (200.0, -200.0, 1e9):
        assert not correlation.lookup(pixel_grid(16, 20)[None] + offset).any()


def test_small_maps_keep_four_levels(net):
    correlation = net.correlation(torch.ones(1, 128, 3, 5), torch.ones(1, 128, 3, 5))
    assert [tuple(level.shape[-2:]) for level in correlation.levels()] == [(3, 5), (1, 2), (1, 1), (1, 1)]
    assert len(correlation.levels()) == CORRELATION_LEVELS


@pytest.mark.parametrize(
    ("image", "text"),
    [
        (torch.zeros(1, 3, 60, 64, dtype=torch.uint8), "multiples of 8"),
        (torch.zeros(1, 3, 64, 63, dtype=torch.uint8), "multiples of 8"),
        (torch.full((1, 3, 64, 64), float("nan")), "uint8"),
        (torch.zeros(3, 64, 64, dtype=torch.uint8), "uint8 images"),
        (torch.zeros(1, 4, 64, 64, dtype=torch.uint8), "uint8 images"),
    ],
)
def test_malformed_images_are_named(net, image, text):
    for action in (net.features, net.context):
        with pytest.raises(FrameError, match=text):
            action(image)


def test_public_file_loads_prefix_stripped_and_heads_cut(tmp_path, monkeypatch, net):
    """The public file carries `module.` names and a third row in the two heads."""
    state = {f"module.{name}": value for name, value in rule_state(DroidNet()).items()}
    for name, rows in checkpoint.CHECKPOINTS["droid"].cut_rows:
        value = state[f"module.{name}"]
        state[f"module.{name}"] = torch.cat([value, torch.ones_like(value[:1])])
        assert rows == 2
    path = tmp_path / "droid.pth"
    torch.save(state, path)
    with pytest.raises(WeightsError, match="SHA-256"):
        DroidNet.from_checkpoint(tmp_path)
    entry = replace(checkpoint.CHECKPOINTS["droid"], sha256=checkpoint.sha256_of(path))
    monkeypatch.setitem(checkpoint.CHECKPOINTS, "droid", entry)
    loaded = DroidNet.from_checkpoint(tmp_path).state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in net.state_dict().items())


def test_wrong_checkpoints_are_refused(tmp_path):
    with pytest.raises(WeightsError, match=r"droid\.pth.*46476ef6"):
        DroidNet.from_checkpoint(tmp_path)
    save_rule_weights(tmp_path, "droid", torch.nn.Linear(2, 2))
    with pytest.raises(WeightsError, match="102 tensors missing"):
        DroidNet.from_checkpoint(tmp_path)


def test_reduced_precision_stays_close(encoded, features, update):
    net = rule_filled(DroidNet(torch.bfloat16)).requires_grad_(False)
    images = torch.from_numpy(features["images_bgr_u8"])
    fmaps = net.features(images)
    assert fmaps.dtype == torch.bfloat16
    assert float((fmaps.float() - encoded[0]).abs().mean()) < 0.05
    hidden, inp = net.context(images)
    ii = torch.from_numpy(update["ii"])
    lookup = net.correlation(fmaps[ii], fmaps[update["jj"]]).lookup(torch.from_numpy(update["coords1"][0]))
    _, delta, weight = net.refine(hidden[ii], inp[ii], lookup, torch.from_numpy(update["motion"][0]))
    assert delta.dtype == weight.dtype == torch.float32
    assert float((delta - torch.from_numpy(update["out_delta"][0])).abs().mean()) < 0.05
