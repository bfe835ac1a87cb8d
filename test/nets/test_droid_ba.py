"""Geometry and dense bundle adjustment: recorded answers of the released kernels, and laws."""

from pathlib import Path

import numpy as np
import pytest
import torch
from weight_rule import rule_filled

from hat_ros.geometry import lie
from hat_ros.nets import droid_geometry as geometry
from hat_ros.nets.droid import DroidNet, upsample_disparity
from hat_ros.nets.droid_ba import (
    EXACT_RULE,
    GLOBAL_DAMPING,
    LOCAL_DAMPING,
    PUBLISHED_RULE,
    TRAINING_RULE,
    BundleLayout,
    Damping,
    _jacobians,
    bundle_adjust,
)

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small tensors gain nothing from a second thread, and two of them spin when the machine is busy."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def data():
    recorded = np.load(DATA / "droid_ba.npz")
    return {name: recorded[name] for name in recorded.files}


def tensor(array):
    return torch.from_numpy(np.asarray(array, dtype=np.float32))


def solve(data, first=1, poses="poses_init", disparities="disps_init", **options):
    layout = BundleLayout(data["ii"], data["jj"], first, 8, "cpu")
    return bundle_adjust(
        tensor(data[poses]),
        tensor(data[disparities]),
        tensor(data["intrinsics8"]),
        tensor(data["target"]),
        tensor(data["weight"]),
        layout,
        eta=tensor(data["eta"]),
        **options,
    )


def worst(actual, expected):
    return float(np.abs(actual.numpy() - expected).max())


CASES = [
    ("t1_it1", 1, 1, LOCAL_DAMPING),
    ("t1_it2", 1, 2, LOCAL_DAMPING),
    ("t1_it8", 1, 8, LOCAL_DAMPING),
    ("t3_it2", 3, 2, LOCAL_DAMPING),
    ("glob_it2", 1, 2, GLOBAL_DAMPING),
]


@pytest.mark.parametrize(("name", "first", "iterations", "damping"), CASES)
@pytest.mark.parametrize(("kind", "rule"), [("k", PUBLISHED_RULE), ("fixed", EXACT_RULE)])
def test_released_kernels(data, kind, rule, name, first, iterations, damping):
    poses, disparities = solve(data, first, iterations=iterations, damping=damping, rule=rule)
    assert worst(poses, data[f"{kind}_{name}_poses"]) < 1e-4
    assert worst(disparities, data[f"{kind}_{name}_disps"]) < 1e-4


def test_released_kernels_motion_only(data):
    poses, disparities = solve(data, disparities="disps_gt", iterations=3, motion_only=True)
    assert worst(poses, data["k_motion_it3_poses"]) < 1e-5
    assert np.array_equal(disparities.numpy(), data["disps_gt"])


def test_released_kernels_with_measured_depth(data):
    poses, disparities = solve(data, sensed=tensor(data["disps_sens"]))
    assert worst(poses, data["k_sens_it2_poses"]) < 1e-4
    assert worst(disparities, data["k_sens_it2_disps"]) < 1e-4


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_training_layer(data, iterations):
    poses, disparities = solve(data, iterations=iterations, rule=TRAINING_RULE)
    assert worst(poses, data[f"pyBA_it{iterations - 1}_poses"]) < 1e-4
    assert worst(disparities, data[f"pyBA_it{iterations - 1}_disps"]) < 1e-4


def test_jacobians_as_published(data):
    layout = BundleLayout(data["ii"], data["jj"], 1, 8, "cpu")
    inputs = [tensor(data[name]) for name in ("poses_init", "disps_init", "intrinsics8", "target", "weight")]
    _, _, J_i, J_j, J_z = _jacobians(*inputs, layout, TRAINING_RULE)
    assert worst(J_i[0], data["Ji_edge0"]) < 1e-4
    assert worst(J_j[0], data["Jj_edge0"]) < 1e-4
    assert worst(J_z[0], data["Jz_edge0"][..., 0]) < 1e-5


def test_jacobians_are_the_derivatives(data):
    """Central differences of the reprojection in float64."""
    layout = BundleLayout(data["ii"], data["jj"], 1, 8, "cpu")
    inputs = [torch.from_numpy(data[name]).double() for name in ("poses_gt", "disps_gt", "intrinsics8")]
    zeros = torch.zeros(len(data["ii"]), 12, 16, 2, dtype=torch.float64)

    def project(poses, disparities):
        return -_jacobians(poses, disparities, inputs[2], zeros, zeros, layout, EXACT_RULE)[0]

    _, _, J_i, J_j, J_z = _jacobians(*inputs, zeros, zeros, layout, EXACT_RULE)
    step = 1e-6
    for column in range(6):
        xi = torch.zeros(6, dtype=torch.float64)
        xi[column] = step
        ahead = geometry.retract(inputs[0][3], xi), geometry.retract(inputs[0][3], -xi)
        moved = [project(torch.cat([inputs[0][:3], pose[None], inputs[0][4:]]), inputs[1]) for pose in ahead]
        slope = (moved[0] - moved[1]) / (2 * step)
        for J, frames in ((J_i, data["ii"]), (J_j, data["jj"])):
            edges = np.flatnonzero(frames == 3)
            assert torch.allclose(slope[edges], J[edges][..., column], atol=1e-5)
    slope = (project(inputs[0], inputs[1] + step) - project(inputs[0], inputs[1] - step)) / (2 * step)
    assert torch.allclose(slope, J_z, atol=1e-5)


def test_reprojection_as_published(data):
    ii, jj = torch.from_numpy(data["ii"][:1]), torch.from_numpy(data["jj"][:1])
    inputs = [tensor(data[name]) for name in ("poses_init", "disps_init", "intrinsics8")]
    coords, counts = geometry.reproject(*inputs, ii, jj)
    assert worst(coords[0], data["coords_edge0"]) < 1e-5
    assert np.array_equal(counts[0].numpy(), data["valid_edge0"][..., 0] > 0)


def test_order_of_edges_does_not_matter(data):
    shuffled = np.random.default_rng(3).permutation(len(data["ii"]))
    again = data | {name: data[name][shuffled] for name in ("ii", "jj", "target", "weight")}
    for first, second in zip(solve(data), solve(again), strict=True):
        assert torch.allclose(first, second, atol=1e-5)


def test_gauge_moves_the_answer_with_it(data):
    """Another world frame gives the same relative poses and depths."""
    gauge = geometry.exp(tensor([0.3, -1.0, 2.0, 0.4, -0.5, 0.2])).expand(8, 7)
    moved = data | {"poses_init": geometry.compose(tensor(data["poses_init"]), gauge).numpy()}
    (poses, disparities), (other, other_disparities) = solve(data), solve(moved)
    assert torch.allclose(geometry.compose(poses, gauge), other, atol=2e-4)
    assert torch.allclose(disparities, other_disparities, atol=2e-4)


def test_exact_flow_is_a_fixed_point_and_is_found(data):
    ii, jj = torch.from_numpy(data["ii"]), torch.from_numpy(data["jj"])
    poses, disparities, intrinsics = (tensor(data[name]) for name in ("poses_gt", "disps_gt", "intrinsics8"))
    target, _ = geometry.reproject(poses, disparities, intrinsics, ii, jj)
    exact = data | {"target": target.numpy(), "weight": np.ones_like(data["weight"]), "eta": np.zeros_like(data["eta"])}
    for rule in (PUBLISHED_RULE, EXACT_RULE):
        still = solve(exact, poses="poses_gt", disparities="disps_gt", rule=rule)
        assert torch.allclose(still[0], poses, atol=1e-5) and torch.allclose(still[1], disparities, atol=1e-4)
        # Poses 0 and 1 of the truth fix the scale; all else is perturbed.
        start = exact | {"poses_init": np.concatenate([data["poses_gt"][:2], data["poses_init"][2:]])}
        found = solve(start, first=2, iterations=12, rule=rule, damping=Damping(1e-6, 1e-6))
        assert torch.allclose(found[0], poses, atol=1e-4)
        assert float((found[1] - disparities).abs().median()) < 1e-3


def test_nothing_free_is_nothing_done(data):
    poses, disparities = solve(data, first=8)
    assert np.array_equal(poses.numpy(), data["poses_init"])
    assert np.array_equal(disparities.numpy(), data["disps_init"])


def test_without_confidence_nothing_moves(data):
    silent = data | {"weight": np.zeros_like(data["weight"])}
    poses, disparities = solve(silent)
    assert torch.allclose(poses, tensor(data["poses_init"]), atol=1e-6)
    assert torch.allclose(disparities, tensor(data["disps_init"]), atol=1e-6)


def test_numbers_that_are_not_finite_are_not_hidden(data):
    broken = data | {"target": np.full_like(data["target"], np.nan)}
    poses, _ = solve(broken, iterations=1)
    assert poses[1:].isnan().all() and torch.equal(poses[0], tensor(data["poses_init"][0]))


def test_a_singular_system_is_left_alone(data):
    blind = data | {"weight": np.zeros_like(data["weight"])}
    poses, _ = solve(blind, damping=Damping(0.0, -1.0))
    assert torch.allclose(poses, tensor(data["poses_init"]), atol=1e-6)


def test_whole_recurrent_run_as_published():
    """Three steps of network and training layer, as in the published forward pass."""
    run, images = np.load(DATA / "droid_forward.npz"), np.load(DATA / "droid_features.npz")["images_bgr_u8"]
    net = rule_filled(DroidNet()).requires_grad_(False)
    images = torch.from_numpy(images)
    features, (hidden, inp) = net.features(images), net.context(images)
    ii, jj = torch.from_numpy(run["edges_i"]), torch.from_numpy(run["edges_j"])
    poses, disparities = tensor(run["poses_init"][0]), tensor(run["disps_init"][0])
    intrinsics, grid = tensor(run["intrinsics8"][0, 0]), geometry.pixel_grid(16, 20)
    layout = BundleLayout(run["edges_i"], run["edges_j"], 2, 3, "cpu")
    correlation, hidden = net.correlation(features[ii], features[jj]), hidden[ii]
    coords, _ = geometry.reproject(poses, disparities, intrinsics, ii, jj)
    target = coords
    for step in range(3):
        motion = torch.cat([coords - grid, target - coords], dim=-1).permute(0, 3, 1, 2)
        hidden, delta, weight = net.refine(hidden, inp[ii], correlation.lookup(coords), motion)
        target, eta = coords + delta, net.damping(hidden, ii, 3)
        poses, disparities = bundle_adjust(
            poses, disparities, intrinsics, target, weight, layout, eta=eta, rule=TRAINING_RULE
        )
        coords, _ = geometry.reproject(poses, disparities, intrinsics, ii, jj)
        got = {
            "poses": poses,
            "disps": disparities,
            "target": target,
            "weight": weight,
            "eta": eta,
            "residual": target - coords,
        }
        for name, value in got.items():
            assert worst(value, run[f"step{step}_{name}"][0]) < 1e-4, (step, name)
    full = upsample_disparity(disparities, net.upsampling_mask(hidden, ii, 3))
    assert worst(full[:, ::3, ::3], run["step2_disps_up_every3"]) < 1e-4


@pytest.mark.parametrize("scale", [1e-7, 1e-4, 1e-2, 0.1, 1.0, 1.5])
def test_exp_and_log_agree_with_the_package(scale):
    xi = np.random.default_rng(5).standard_normal((64, 6)) * scale
    xi[:, 3:] *= np.minimum(1.0, 3.0 / np.linalg.norm(xi[:, 3:], axis=1, keepdims=True))
    pose = geometry.exp(torch.from_numpy(xi))
    assert np.allclose(
        lie.matrix_from_row(pose.numpy())[:, :3, :3], lie.so3_exp(xi[:, 3:]), atol=1e-10 if scale < 1 else 1e-9
    )
    assert torch.allclose(geometry.log(pose), torch.from_numpy(xi), atol=1e-9)
    single = geometry.log(geometry.exp(torch.from_numpy(xi).float()))
    assert torch.allclose(single, torch.from_numpy(xi).float(), atol=2e-6 * max(1.0, scale * 10))


def test_group_laws():
    a, b = (geometry.exp(torch.randn(32, 6, generator=torch.Generator().manual_seed(seed))) for seed in (1, 2))
    assert torch.allclose(geometry.compose(a, geometry.invert(a))[:, :3], torch.zeros(32, 3), atol=1e-5)
    left = lie.matrix_from_row(geometry.compose(a, b).double().numpy())
    right = lie.matrix_from_row(a.double().numpy()) @ lie.matrix_from_row(b.double().numpy())
    assert np.allclose(left, right, atol=1e-5)
    flipped = torch.cat([a[:, :3], -a[:, 3:]], dim=1)
    assert torch.allclose(geometry.log(flipped), geometry.log(a), atol=1e-5)
