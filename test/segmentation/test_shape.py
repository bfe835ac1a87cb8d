import cv2
import numpy as np
import pytest

from hat_ros.segmentation.shape import SilhouetteBank
from hat_ros.target.ray_renderer import RayRenderer


@pytest.fixture(scope="module")
def bank(lopsided):
    return SilhouetteBank(lopsided, RayRenderer(lopsided))


def random_poses(scene, count):
    rng = np.random.default_rng(3)
    for _ in range(count):
        yield scene.pose(rng.uniform(0, 6.3), *rng.uniform(-0.6, 0.6, 2), rng.uniform(5, 14))


def test_every_view_of_the_model_is_plausible(bank, scene):
    assert min(bank.overlap(scene.truth(T)) for T in random_poses(scene, 12)) > 0.8


def test_views_cut_by_the_border_are_plausible(bank, scene):
    for x, y in ((-2.2, 0), (2.2, 0.2), (0, 1.8), (0.2, -1.8)):
        mask = scene.truth(scene.pose(0.7, x, y))
        assert mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()
        assert bank.overlap(mask) > 0.75


def test_position_size_and_roll_drop_out(bank, scene):
    mask = scene.truth(scene.pose(0.7)).astype(np.uint8)
    turn = cv2.getRotationMatrix2D((160, 120), 70, 0.7)
    other = cv2.warpAffine(mask, turn, (320, 240), flags=cv2.INTER_NEAREST)
    assert abs(bank.overlap(mask > 0) - bank.overlap(other > 0)) < 0.05


def test_what_is_not_the_model_is_less_plausible(bank, scene):
    worst = min(bank.overlap(scene.truth(T)) for T in random_poses(scene, 12))
    ring = np.zeros((240, 320), np.uint8)
    cv2.circle(ring, (160, 120), 60, 1, 10)
    cross = np.zeros((240, 320), np.uint8)
    cross[40:200, 150:170] = cross[110:130, 60:260] = 1
    for mask in (ring, cross):
        assert bank.overlap(mask > 0) < 0.6 < worst


def test_nothing_is_not_plausible(bank):
    assert bank.overlap(np.zeros((50, 60), bool)) == 0.0


def test_silhouettes_are_rendered_once_per_model(lopsided, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    n_rendered = 0

    class Counted(RayRenderer):
        def render(self, *args, **kwargs):
            nonlocal n_rendered
            n_rendered += 1
            return super().render(*args, **kwargs)

    banks = [SilhouetteBank(lopsided, Counted(lopsided), n_views=162) for _ in range(2)]
    assert n_rendered == 162
    mask = np.zeros((100, 140), np.bool_)
    mask[20:70, 30:60] = True
    assert banks[0].overlap(mask) == banks[1].overlap(mask)
