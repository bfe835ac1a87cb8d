"""The learned hypothesis backends around their networks: plumbing, caches, missing weights."""

import numpy as np
import pytest
import torch
import trimesh
from rule_weights import save_rule_weights

from hat_ros.config import config_from_dict
from hat_ros.errors import WeightsError
from hat_ros.geometry import lie
from hat_ros.hypotheses import gigapose, megapose, picopose
from hat_ros.hypotheses.picopose_templates import SquareCrop, render_templates, square_crop, template_poses
from hat_ros.nets import gigapose as gp
from hat_ros.nets import megapose as mp
from hat_ros.nets.runtime import Runtime
from hat_ros.stages import create_backend
from hat_ros.target.loading import target_from_scene
from hat_ros.target.sphere import look_inwards_upright
from hat_ros.types import Camera, Detection, Frame

CAMERA = Camera(np.array([[300.0, 0, 79.5], [0, 300.0, 59.5], [0, 0, 1]]), 160, 120)


@pytest.fixture(scope="module")
def target():
    body = trimesh.creation.box(extents=(1.0, 0.6, 0.4))
    wing = trimesh.creation.box(extents=(0.8, 0.02, 0.4))
    wing.apply_translation([0.9, 0, 0])
    return target_from_scene(trimesh.Scene([body, wing]), "toy")


@pytest.fixture
def frame():
    rng = np.random.default_rng(0)
    return Frame(1, rng.integers(0, 255, (120, 160, 3), dtype=np.uint8), CAMERA)


@pytest.fixture
def detection():
    mask = np.zeros((120, 160), bool)
    mask[40:80, 50:110] = True
    return Detection(mask)


@pytest.mark.parametrize("backend", ["megapose", "picopose", "gigapose"])
def test_missing_weights_say_what_where_and_how(backend, target, tmp_path):
    config = config_from_dict({"hypotheses": {"backend": backend}, "nets": {"weights_folder": str(tmp_path)}})
    with pytest.raises(WeightsError, match=r"SHA-256 .*put it there") as caught:
        create_backend("hypotheses", config, target)
    assert str(tmp_path) in str(caught.value)


def test_megapose_gives_k_rigid_poses_and_renders_its_grid_once(target, frame, detection, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    save_rule_weights(tmp_path, "megapose_coarse", mp.CoarseNet())
    save_rule_weights(tmp_path, "megapose_refiner", mp.RefinerNet())
    # A coarser grid than the published one keeps this test short; the code path is the same.
    monkeypatch.setattr(megapose, "so3_grid", lambda level: np.eye(4)[:, [3, 0, 1, 2]])
    config = config_from_dict(
        {
            "hypotheses": {"max_candidates": 2, "megapose": {"refiner_iterations": 1}},
            "nets": {"weights_folder": str(tmp_path)},
        }
    )
    backend = megapose.MegaPoseHypotheses(config, target)
    first = backend.generate(frame, detection, None)
    assert len(first) == 2
    assert lie.is_rigid(first.T_cam_target).all()
    assert first.log_score[0] >= first.log_score[1]
    np.testing.assert_array_equal(first.box_xyxy, detection.box_xyxy)
    monkeypatch.setattr(backend, "_render_coarse", lambda camera: pytest.fail("rendered again"))
    again = backend.generate(frame, detection, None)
    np.testing.assert_array_equal(again.pose_rows, first.pose_rows)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 1e-2), ("float16", 0.2)])
def test_megapose_on_a_gpu_agrees_with_the_cpu(target, frame, detection, tmp_path, monkeypatch, precision, tolerance):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    save_rule_weights(tmp_path, "megapose_coarse", mp.CoarseNet())
    save_rule_weights(tmp_path, "megapose_refiner", mp.RefinerNet())
    monkeypatch.setattr(megapose, "so3_grid", lambda level: np.eye(4)[:, [3, 0, 1, 2]])
    found = []
    for device in ("cpu", "cuda"):
        settings = {"max_candidates": 4, "megapose": {"refiner_iterations": 0}}  # random updates amplify differences
        nets = {"weights_folder": str(tmp_path), "device": device, "precision": precision}
        config = config_from_dict({"hypotheses": settings, "nets": nets})
        found.append(megapose.MegaPoseHypotheses(config, target).generate(frame, detection, None))
    np.testing.assert_allclose(found[1].log_score, found[0].log_score, atol=tolerance)


def test_few_vertices_are_made_up_for_by_surface_points(target):
    points = megapose.crop_points(target, Runtime(config_from_dict({}).nets, "megapose"))
    assert points.crop.shape == (2000, 3)
    assert points.views.shape == (200, 3)
    np.testing.assert_allclose(points.crop.amax(dim=0), target.vertices_m.max(axis=0), atol=0.02)


def test_box_padding_is_a_tenth_on_each_side_and_clipped_to_the_image():
    padding = config_from_dict({}).hypotheses.megapose.box_padding
    padded = megapose.padded_box(np.array([5.0, 20.0, 105.0, 60.0]), padding, CAMERA)
    np.testing.assert_allclose(padded, [0, 16, 115, 64])


def test_fewer_hypotheses_are_the_best_coarse_ones_and_not_the_best_refined(
    target, frame, detection, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    save_rule_weights(tmp_path, "megapose_coarse", mp.CoarseNet())
    save_rule_weights(tmp_path, "megapose_refiner", mp.RefinerNet())
    monkeypatch.setattr(megapose, "so3_grid", lambda level: np.eye(4)[:, [3, 0, 1, 2]])
    found = {}
    for k in (4, 2):
        settings = {"max_candidates": k, "megapose": {"refiner_iterations": 1}}
        config = config_from_dict({"hypotheses": settings, "nets": {"weights_folder": str(tmp_path)}})
        found[k] = megapose.MegaPoseHypotheses(config, target).generate(frame, detection, None)
    assert sorted(found[4].rank) == [0, 1, 2, 3]
    fewer = found[4].first(2)
    np.testing.assert_allclose(fewer.pose_rows, found[2].pose_rows, atol=1e-4)
    np.testing.assert_allclose(fewer.log_score, found[2].log_score, atol=1e-4)


def test_megapose_refines_a_pose_given_and_says_how_well_its_silhouette_fits(
    target, frame, detection, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    save_rule_weights(tmp_path, "megapose_coarse", mp.CoarseNet())
    save_rule_weights(tmp_path, "megapose_refiner", mp.RefinerNet())
    settings = {"megapose": {"refiner_iterations": 0}}
    config = config_from_dict({"hypotheses": settings, "nets": {"weights_folder": str(tmp_path)}})
    backend = megapose.MegaPoseHypotheses(config, target)
    T = lie.transform(np.eye(3), np.array([0.0, 0.0, 6.0]))
    refined = backend.refine(frame, detection, T)
    np.testing.assert_allclose(refined.T_cam_target, T, atol=1e-6)
    assert 0.1 < refined.overlap < 1.0
    assert 0.0 < refined.support < 1.0
    assert np.isnan(backend.refine(frame, None, T).overlap)


def test_square_crop_is_even_inside_and_invertible():
    mask = np.zeros((120, 160), bool)
    mask[100:119, 130:159] = True
    crop = square_crop(mask)
    assert crop.side % 2 == 0
    assert crop.x0 >= 0 and crop.y0 >= 0
    assert crop.x0 + crop.side <= 160 and crop.y0 + crop.side <= 120
    corner = crop.M @ [crop.x0, crop.y0, 1]
    np.testing.assert_allclose(corner, [0, 0, 1], atol=1e-12)
    assert crop.resize_mask(mask).shape == (224, 224)


def test_templates_see_the_whole_target_centred(target):
    poses = template_poses(target)
    assert poses.shape == (162, 4, 4)
    assert lie.is_rigid(poses).all()
    centre = poses[:, :3, :3] @ target.center_m + poses[:, :3, 3]
    np.testing.assert_allclose(centre[:, :2], 0, atol=1e-9)


def test_template_points_lie_on_the_target(target, monkeypatch):
    few = look_inwards_upright(12)[:3]
    monkeypatch.setattr("hat_ros.hypotheses.picopose_templates.look_inwards_upright", lambda n_views: few)
    templates = render_templates(target)
    points = templates.points_m[np.isfinite(templates.points_m).all(axis=-1)]
    distance = trimesh.proximity.closest_point_naive(
        trimesh.Trimesh(target.vertices_m, target.faces, process=False), points[::40]
    )[1]
    assert distance.max() < 1e-4
    assert 0.2 < templates.masks.mean() < 1


def test_pnp_recovers_a_planted_pose_and_refuses_nothing_to_solve():
    rng = np.random.default_rng(1)
    T = lie.transform(lie.so3_exp(np.array([0.3, -0.5, 0.2])), np.array([0.05, -0.02, 4.0]))
    crop = SquareCrop(40, 20, 80)
    points = np.full((64, 64, 3), np.nan, np.float32)
    cells = rng.permutation(64 * 64)[:300]
    source = np.stack([cells % 64, cells // 64], axis=1)
    at = rng.integers(8, 56, (300, 2))
    px = (at + 0.5) * 3.5 / (224 / 80) + [crop.x0, crop.y0]
    depth = rng.uniform(3.5, 4.5, 300)
    rays = np.concatenate([(px - CAMERA.K[:2, 2]) / 300.0, np.ones((300, 1))], axis=1)
    points[source[:, 1], source[:, 0]] = (rays * depth[:, None] - T[:3, 3]) @ T[:3, :3]
    settings = config_from_dict({}).hypotheses.picopose
    pose, score = picopose.solve_pose(source, at, points, crop.M, CAMERA.K, settings)
    np.testing.assert_allclose(pose, T, atol=1e-4)
    assert score == 1.0
    nothing = np.full_like(points, np.nan)
    assert picopose.solve_pose(source, at, nothing, crop.M, CAMERA.K, settings) is None


def test_fingerprint_follows_the_weights():
    state = {"a": torch.ones(3), "b": torch.zeros(2)}
    assert picopose.fingerprint(state) == picopose.fingerprint(dict(reversed(state.items())))
    assert picopose.fingerprint(state) != picopose.fingerprint({**state, "b": torch.ones(2)})


def test_letterbox_keeps_aspect_and_centres():
    mask = np.zeros((120, 160), bool)
    mask[30:60, 40:100] = True
    M = gigapose.letterbox(mask)
    assert M[0, 0] == M[1, 1] == 224 / 60
    rng = np.random.default_rng(0)
    image = rng.integers(1, 255, (120, 160, 3), dtype=np.uint8)
    crop = gigapose.cut(image, mask, M)
    rows = np.flatnonzero(crop[..., 3].any(axis=1))
    assert crop[..., 3].any(axis=0).all()
    assert abs(rows[0] - (223 - rows[-1])) <= 1
    np.testing.assert_array_equal(crop[rows[0], 0], [*image[30, 40], 1])
    np.testing.assert_array_equal(crop[..., :3].any(axis=2), crop[..., 3] > 0)  # the surroundings are not shown


def test_gigapose_one_point_ransac_recovers_a_similarity():
    rng = np.random.default_rng(2)
    template = torch.tensor(rng.uniform(0, 224, (60, 2)), dtype=torch.float32)
    angle, scale = 0.4, 1.3
    linear = scale * torch.tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]).float()
    image = template @ linear.T + torch.tensor([5.0, -8.0])
    image[:20] = torch.tensor(rng.uniform(0, 224, (20, 2)), dtype=torch.float32)
    inplane = torch.tensor([[np.cos(angle), np.sin(angle)]]).float().expand(60, 2)
    affine, inliers = gp.best_similarity(template, image, torch.full((60,), scale), inplane)
    assert inliers >= 40
    torch.testing.assert_close(affine[:2, :2], linear, atol=1e-4, rtol=0)
    torch.testing.assert_close(affine[:2, 2], torch.tensor([5.0, -8.0]), atol=1e-2, rtol=0)


def test_gigapose_scale_is_stretched_by_the_length_of_the_rotation():
    point, half = torch.zeros(1, 2), torch.tensor([[0.5, 0.0]])
    affine, _ = gp.best_similarity(point, point, torch.tensor([3.0]), half)
    torch.testing.assert_close(affine, torch.diag(torch.tensor([1.5, 1.5, 1.0])))


def test_gigapose_parameter_names_are_the_checkpoints():
    norm = ["weight", "bias", "running_mean", "running_var", "num_batches_tracked"]
    names = ["conv1.weight", *(f"bn1.{name}" for name in norm), "layer4_outconv.weight"]
    for layer in range(1, 5):
        for block in range(2):
            prefix = f"layer{layer}.{block}"
            names += [f"{prefix}.conv{i}.weight" for i in (1, 2)]
            names += [f"{prefix}.bn{i}.{name}" for i in (1, 2) for name in norm]
        if layer > 1:
            names += [f"layer{layer}.0.downsample.{name}" for name in ("0.weight", *(f"1.{name}" for name in norm))]
    names = [f"ist_net.backbone.{name}" for name in names]
    for head in ("scale_predictor", "inplane_predictor"):
        names += [f"ist_net.regressor.{head}.{i}.{name}" for i in (0, 2, 4) for name in ("weight", "bias")]
    with torch.device("meta"):
        state = gp.GigaPoseNet().state_dict()
    assert sorted(names) == sorted(name for name in state if name.startswith("ist_net."))
    assert all(name.startswith(("ist_net.", "ae_net.dinov2_model.")) for name in state)


def test_gigapose_matches_each_image_patch_and_forgets_weak_ones():
    # Both patches of the image look like template patch 40; one is far from where the way back ends.
    features = torch.zeros(4, 256)
    features[3] = 1
    features[:, 40] = torch.tensor([1.0, 0, 0, 0])
    features[:, 200] = torch.tensor([0.9, 0.435890, 0, 0])
    features[:, 41] = torch.tensor([0.4, 0, 0.916515, 0])  # below the threshold
    template = torch.zeros(4, 256)
    template[2] = 1
    template[:, 40] = torch.tensor([1.0, 0, 0, 0])
    mask = torch.zeros(256)
    mask[[40, 200, 41]] = 1
    only = torch.zeros(256)
    only[40] = 1
    found = gp.match(
        features.reshape(4, 16, 16), mask.reshape(16, 16), template.reshape(1, 4, 16, 16), only.reshape(1, 16, 16)
    )
    assert (found[0].image.tolist(), found[0].template.tolist()) == ([40], [40])


def test_gigapose_matches_must_agree_both_ways():
    generator = torch.Generator().manual_seed(0)
    features = torch.nn.functional.normalize(torch.randn(64, 16, 16, generator=generator), dim=0)
    ones = torch.ones(16, 16)
    found = gp.match(features, ones, features[None], ones[None])[0]
    assert found.template.tolist() == found.image.tolist() == list(range(1, 256))
    nothing = gp.match(features, ones, features[None], torch.zeros(1, 16, 16))[0]
    assert len(nothing.template) == 0
