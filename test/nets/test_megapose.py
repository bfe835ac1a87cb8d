"""MegaPose against the recorded answers of the public implementation with rule weights."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from weight_rule import rule_filled, rule_state

from hat_ros.errors import WeightsError
from hat_ros.geometry import lie
from hat_ros.nets import megapose as mp

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(scope="module")
def coarse():
    return np.load(DATA / "megapose_coarse.npz")


@pytest.fixture(scope="module")
def refiner():
    return np.load(DATA / "megapose_refiner.npz")


def tensor(array):
    return torch.from_numpy(np.asarray(array, dtype=np.float32))


def points_of(coarse):
    points = tensor(coarse["points"])
    draw = [np.random.RandomState(0).choice(len(points), n, replace=False) for n in (2000, 200)]
    return mp.CropPoints(points[draw[0]], points[draw[1]])


@pytest.mark.parametrize(("name", "kind"), [("megapose_coarse", mp.CoarseNet), ("megapose_refiner", mp.RefinerNet)])
def test_every_tensor_has_the_published_name_and_shape(name, kind):
    published = json.loads(gzip.decompress((DATA / "net_tensors.json.gz").read_bytes()))[name]
    assert {key: list(value.shape) for key, value in kind().state_dict().items()} == published


def test_layout_is_read_from_the_stem():
    for pre_activation in (False, True):
        net = mp.CoarseNet(pre_activation)
        built = mp.build_net(mp.CoarseNet, net.state_dict())
        assert built.state_dict().keys() == net.state_dict().keys()
        assert built(torch.zeros(1, 9, 240, 320)).shape == (1,)
    with pytest.raises(WeightsError, match="3x3 kernel"):
        mp.build_net(mp.CoarseNet, {"backbone.conv1.weight": torch.zeros(64, 9, 3, 3)})
    with pytest.raises(WeightsError, match="no tensor"):
        mp.build_net(mp.CoarseNet, {})


def test_coarse_geometry(coarse):
    R = tensor(lie.matrix_from_quat(coarse["so3_grid_576_quat_xyzw"])[coarse["grid_ids"]])
    K = tensor(coarse["K"])
    T = mp.pose_from_box(R, tensor(coarse["points"]), K, tensor(coarse["boxes"]))
    np.testing.assert_allclose(T, coarse["TCO_init"], atol=1e-5)
    T = mp.orthonormalise(tensor(coarse["TCO_init"]))
    Ks, points = K.expand(4, 3, 3), points_of(coarse)
    np.testing.assert_allclose(mp.project_boxes(T, Ks, points.crop), coarse["boxes_rend"], atol=1e-2)
    boxes = mp.crop_boxes(T, Ks, points.crop, (480, 640))
    np.testing.assert_allclose(boxes, coarse["boxes_crop"], atol=1e-2)
    np.testing.assert_allclose(mp.crop_intrinsics(Ks, boxes), coarse["K_crop"], atol=1e-2)
    crops = mp.roi_align(tensor(coarse["image_rgb_u8"]) / 255, boxes)
    np.testing.assert_allclose(crops[:, :, ::16, ::16], coarse["coarse_crop_sub4"], atol=1e-4)


def test_coarse_logits(coarse):
    net = rule_filled(mp.CoarseNet())
    renders = tensor(coarse["coarse_renders_u8"]) / 255
    with torch.inference_mode():
        logits = mp.score_renders(net, tensor(coarse["image_rgb_u8"]) / 255, tensor(coarse["boxes_crop"][:2]), renders)
    np.testing.assert_allclose(logits, coarse["coarse_logits"][:2, 0], atol=1e-4)


def test_roi_align_is_zero_outside_and_exact_on_a_ramp():
    ramp = torch.arange(40.0).expand(1, 30, 40)
    crop = mp.roi_align(ramp, torch.tensor([[4.0, 3.0, 36.0, 27.0]]))[0, 0]
    centres = 4 + (torch.arange(320) + 0.5) * 32 / 320
    torch.testing.assert_close(crop[100], centres, atol=1e-4, rtol=0)
    outside = mp.roi_align(ramp + 1, torch.tensor([[-200.0, -200.0, -100.0, -100.0]]))
    assert float(outside.abs().max()) == 0


def test_a_crop_does_not_depend_on_the_others_beside_it():
    """Crops look at the part of the image that any of them reaches; more of it must change nothing."""
    image = torch.rand(3, 60, 90, generator=torch.Generator().manual_seed(0))
    boxes = torch.tensor(
        [[20.0, 10, 50, 40], [-15.5, -8, 12, 20], [70, 40, 140, 95], [-50, -50, 150, 120], [30.2, 30.1, 30.5, 30.4],
         [200, 10, 230, 40], [10, 200, 40, 220], [88.9, 58.9, 92, 62]]
    )  # fmt: skip
    together = mp.roi_align(image, boxes)
    for i in range(len(boxes)):
        torch.testing.assert_close(mp.roi_align(image, boxes[i : i + 1])[0], together[i], atol=1e-4, rtol=0)
    assert mp.roi_align(image, torch.full((1, 4), float("nan"))).shape == (1, 3, 240, 320)


def test_refiner_iteration(coarse, refiner):
    net = rule_filled(mp.RefinerNet())
    T = mp.orthonormalise(tensor(refiner["TCO_input"]))
    np.testing.assert_allclose(T, refiner["TCO_input_normalised"], atol=1e-6)
    image = tensor(coarse["image_rgb_u8"]) / 255
    K_crop, crops, T_views, K_views = mp.refiner_inputs(image, tensor(coarse["K"]), T, points_of(coarse))
    np.testing.assert_allclose(K_crop, refiner["K_crop"], atol=1e-2)
    np.testing.assert_allclose(T_views, refiner["TCV_O"], atol=1e-5)
    np.testing.assert_allclose(K_views, refiner["KV_crop"], atol=1e-2)
    with torch.inference_mode():
        update = net(torch.cat([crops[:1], tensor(refiner["renders_u8"]) / 255], dim=1))
    np.testing.assert_allclose(update, refiner["pose_out"][:1], atol=1e-4)
    np.testing.assert_allclose(mp.apply_update(T[:1], K_crop[:1], update), refiner["TCO_output"][:1], atol=1e-5)


def test_pose_update_and_extra_views(refiner):
    T = mp.apply_update(tensor(refiner["upd_TCO"]), tensor(refiner["upd_K"]), tensor(refiner["upd_pose_out"]))
    np.testing.assert_allclose(T, refiner["upd_TCO_out"], atol=1e-5)
    np.testing.assert_allclose(mp.extra_views(tensor(refiner["mv_TCO"])), refiner["mv_TCV_O"], atol=1e-5)


def test_identity_update_changes_nothing(refiner):
    T = mp.orthonormalise(tensor(refiner["upd_TCO"]))
    identity = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 1]).expand(len(T), 9)
    torch.testing.assert_close(mp.apply_update(T, tensor(refiner["upd_K"]), identity), T, atol=1e-6, rtol=0)


class EllipsoidRenderer:
    """The stand-in scene of the recorded trace: a textured ellipsoid, rays through integer pixels."""

    AXES = np.array([0.5, 0.3, 0.2])

    def render_views(self, T_cam_target, K):
        views = [self._render(T, k) for T, k in zip(T_cam_target.double().numpy(), K.double().numpy(), strict=True)]
        return tensor(np.stack(views)) / 255

    def _render(self, T, K):
        v, u = np.mgrid[:240, :320]
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1) @ T[:3, :3]
        origin = -T[:3, :3].T @ T[:3, 3]
        o, d = origin / self.AXES, rays / self.AXES
        a, b, c = (d**2).sum(-1), (d * o).sum(-1), (o**2).sum() - 1
        discriminant = b * b - a * c
        hit = discriminant > 0
        x = origin + rays * ((-b - np.sqrt(np.maximum(discriminant, 0))) / a)[..., None]
        rgb = 0.5 + 0.5 * np.sin(x * [17, 23, 29] + [0, 1, 2])
        normal = x / self.AXES**2
        normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True) @ T[:3, :3].T * [1, -1, -1]
        image = np.concatenate([rgb, normal % 1.0], axis=-1) * hit[..., None]
        return np.round(image * 255).transpose(2, 0, 1)


def test_five_iterations_follow_the_recorded_trace(coarse, refiner):
    net = mp.RefinerNet()
    state = rule_state(net)
    state["pose_fc.weight"] *= 0.02
    state["pose_fc.bias"] = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 1])
    net.load_state_dict(state)
    net.eval()
    image, K, points = tensor(coarse["image_rgb_u8"]) / 255, tensor(coarse["K"]), points_of(coarse)
    T = tensor(refiner["TCO_input"])
    with torch.inference_mode():
        for step in range(1, 6):
            T = mp.refine_once(net, image, K, T, points, EllipsoidRenderer())
            np.testing.assert_allclose(T, refiner[f"trace_TCO_{step}"], atol=1e-4)
