"""PicoPose against the recorded answers of the public implementation with rule weights."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from weight_rule import rule_filled

from hat_ros.nets import picopose as pp
from hat_ros.nets.dinov2 import DinoV2
from hat_ros.nets.picopose_offset import OffsetRegressor, lookup_correlation, pixel_grid

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(scope="module")
def recorded():
    return np.load(DATA / "picopose.npz")


def tensor(array):
    return torch.from_numpy(np.asarray(array, dtype=np.float32))


def test_every_tensor_has_the_published_name_and_shape():
    published = json.loads(gzip.decompress((DATA / "net_tensors.json.gz").read_bytes()))["picopose"]
    with torch.device("meta"):
        net = pp.PicoPoseNet()
    assert {key: list(value.shape) for key, value in net.state_dict().items()} == published
    assert len(published) == 603


def test_affine_regressor_matrix_and_pose(recorded):
    M, K = tensor(recorded["real_M"][0]), tensor(recorded["real_K"][0])
    pose = pp.affine_pose(
        tensor(recorded["ctl_M"]),
        M,
        K,
        tensor(recorded["ctl_tem_pose"]),
        tensor(recorded["ctl_tem_M"]),
        tensor(recorded["tem_K"]),
    )
    np.testing.assert_allclose(pose, recorded["ctl_pose2d"], atol=1e-5)
    best = int(recorded["match_id"][0, 0])
    T = tensor(recorded["tem_pose"][best : best + 1])
    centre = (tensor(recorded["tem_K"]) @ T[:, :3, 3:])[..., 0]
    centre = (tensor(recorded["tem_M"][best : best + 1]) @ (centre / centre[:, 2:])[:, :, None])[:, :2, 0]
    affine = pp.affine_matrix(
        tensor(recorded["h0_translation"]), tensor(recorded["h0_scale"]), tensor(recorded["h0_inplane"]), centre
    )
    np.testing.assert_allclose(affine, recorded["h0_pred_M"], atol=1e-4)


def test_initial_flow(recorded):
    best = int(recorded["match_id"][0, 0])
    mask = pp.patch_mask(tensor(recorded["tem_mask"][best : best + 1]))
    for name in ("h0", "ctl"):
        affine = tensor(recorded["h0_pred_M" if name == "h0" else "ctl_M"])
        np.testing.assert_allclose(pp.initial_flow(affine, mask), recorded[f"{name}_init_flow"], atol=1e-4)


def test_position_table_is_used_as_it_is_at_its_own_size():
    net = DinoV2(dim=32, n_blocks=2, n_heads=2, grid=4)
    torch.nn.init.normal_(net.pos_embed)
    assert net._positions(4, 4) is net.pos_embed
    assert net._positions(2, 2).shape == (1, 5, 32)


def test_features_are_those_of_the_asked_blocks():
    net = rule_filled(DinoV2(dim=32, n_blocks=4, n_heads=2, grid=4))
    with torch.inference_mode():
        crops = torch.rand(2, 3, 28, 28, generator=torch.Generator().manual_seed(0))
        early, late = net(crops, (1, 3))
        torch.testing.assert_close(net(crops, (1,))[0], early)
    assert early.shape == late.shape == (2, 32, 2, 2)
    assert not torch.allclose(early, late)


def test_correlation_lookup_follows_the_window(recorded):
    # A map whose only bright cell lies two cells right of and one below the centre of the window.
    image = torch.zeros(1, 4, 16, 16)
    image[0, :, 9, 10] = 1
    template = torch.ones(1, 4, 16, 16)
    centre = pixel_grid(16, image)[None]
    found = lookup_correlation(template, image, centre, 1)[0, :, 8, 8].reshape(5, 5)
    assert found.nonzero().tolist() == [[4, 3]]  # x offset +2 is the slow index, y offset +1 the fast one
    assert lookup_correlation(template, image, centre + 100, 2).abs().max() == 0


def test_uncertain_and_outside_matches_are_dropped():
    flow, certainty = torch.zeros(2, 64, 64), torch.full((1, 64, 64), -1.0)
    certainty[0, 10, 20:24] = 1.0
    flow[0, 10, 21], flow[1, 10, 22] = 43.0, -10.5
    flow[0, 10, 23] = 0.9
    source, at = pp.correspondences(flow, certainty)
    assert source.tolist() == [[20, 10], [23, 10]]
    assert at.tolist() == [[20, 10], [23, 10]]


def test_offset_stage_runs_at_its_three_levels():
    net = rule_filled(OffsetRegressor(dim=8))
    features = [torch.rand(1, 8, 16, 16, generator=torch.Generator().manual_seed(i)) for i in range(4)]
    with torch.inference_mode():
        maps = net.dpt_head(features)
        levels = net.flow_decoder(maps, maps, torch.zeros(1, 2, 16, 16), torch.zeros(1, 1, 16, 16))
    assert [tuple(flow.shape[-2:]) for flow, _ in levels] == [(16, 16), (32, 32), (64, 64)]


@pytest.mark.slow
def test_full_size_network_agrees_with_the_reference(recorded):
    net = rule_filled(pp.PicoPoseNet())
    with torch.inference_mode():
        image = net.feature_extractor(pp.normalise_crops(tensor(recorded["real_img_u8_bgr"]) / 255))
        templates = net.feature_extractor(pp.normalise_crops(tensor(recorded["tem_img_u8_bgr"]) / 255))
        for block, features in zip(pp.FEATURE_BLOCKS, image, strict=True):
            np.testing.assert_allclose(features.mean((2, 3)), recorded[f"real_feat_mean_block{block}"], atol=1e-3)
        np.testing.assert_allclose(image[-1][:, :16], recorded["real_feat_block23_first16"], atol=1e-3)
        np.testing.assert_allclose(templates[-1][:, :4], recorded["tem_feat_last_first4"], atol=1e-3)
        mask = pp.patch_mask(tensor(recorded["real_mask"]))[0]
        masks = pp.patch_mask(tensor(recorded["tem_mask"]))
        scores = pp.match_templates(image[-1][0], mask, templates[-1])
        best = scores.argsort(descending=True)[:5]
        assert best.tolist() == recorded["match_id"][0].tolist()
        np.testing.assert_allclose(scores[best], recorded["match_score"][0], atol=1e-5)
        similarity = pp.similarity_volume(image[-1][0], templates[-1][best], masks[best])
        np.testing.assert_allclose(similarity[:1, ::16], recorded["h0_sim"], atol=1e-4)
        translation, scale, inplane = net.affine_regressor(similarity)
        np.testing.assert_allclose(translation[:1], recorded["h0_translation"], atol=1e-4)
        np.testing.assert_allclose(scale[:1], recorded["h0_scale"], atol=1e-4)
        np.testing.assert_allclose(inplane[:1], recorded["h0_inplane"], atol=1e-4)
        head = net.offset_regressor.dpt_head
        dpt_image, dpt_templates = head(image), head([level[best[:1]] for level in templates])
        for level in range(3):
            np.testing.assert_allclose(dpt_image[level][:, :2], recorded[f"h0_dpt_real_l{level}_first16"], atol=1e-3)
        for name, matrix, tolerance in (("h0", "h0_pred_M", 1e-2), ("ctl", "ctl_M", 1e-2)):
            flow = pp.initial_flow(tensor(recorded[matrix]), masks[best[:1]])
            levels = net.offset_regressor.flow_decoder(dpt_templates, dpt_image, flow, masks[best[:1]][:, None])
            np.testing.assert_allclose(levels[2][0], recorded[f"{name}_flow_l2"], atol=tolerance)
            certainty = recorded[f"{name}_cert_l2"]
            np.testing.assert_allclose(levels[2][1], certainty, atol=tolerance)
