import numpy as np
import pytest
from shape_scene import CAMERA, pose_errors, random_pose, spacecraft, sunlit_picture

from hat_ros.hypotheses.lit_bank import build_lit, load_or_build_lit, sun_directions
from hat_ros.hypotheses.matching import match_light
from hat_ros.hypotheses.scoring import Scorer
from hat_ros.refinement.mask_field import MaskField
from hat_ros.refinement.view import TargetViewer

SUN = np.array([-1.0, 0.4, -0.1])


@pytest.fixture(scope="module")
def viewer():
    return TargetViewer(spacecraft())


@pytest.fixture(scope="module")
def bank(viewer):
    return build_lit(viewer, 72)


def test_every_entry_is_described(bank):
    n = len(bank.R_cam_target)
    assert n > 1000
    assert bank.spectrum.shape[1] == n == len(bank.to_sun_cam) == len(bank.gyration)
    np.testing.assert_allclose(np.linalg.norm(bank.to_sun_cam, axis=1), 1)
    assert (bank.gyration > 0).all()
    assert np.isfinite(bank.contour_m).all()


def test_suns_are_unit_directions_in_front_and_a_little_behind():
    suns = sun_directions()
    np.testing.assert_allclose(np.linalg.norm(suns, axis=1), 1)
    assert suns[:, 2].min() < -0.7
    assert 0 < suns[:, 2].max() < 0.5


@pytest.mark.parametrize("seed", range(5))
def test_a_body_half_in_shadow_is_among_the_matches(viewer, bank, seed):
    T_true = random_pose(np.random.default_rng(seed), viewer.target)
    frame, _ = sunlit_picture(viewer.target, T_true, SUN)
    luma = frame.rgb.max(axis=2)
    light = Scorer(viewer, frame, MaskField(luma > 16), 96).light()
    matches = match_light(bank, light, CAMERA, 12, 15.0, viewer.target.center_m)
    turn, shift = pose_errors(matches.T_cam_target, T_true)
    best = np.argmin(turn)
    assert turn[best] < 25
    assert shift[best] < 0.25
    assert (np.diff(matches.score) <= 0).all()


def test_the_same_bank_comes_back_from_the_cache(viewer, bank, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for _ in range(2):
        loaded = load_or_build_lit(viewer, 72)
        for name, array in vars(bank).items():
            np.testing.assert_array_equal(getattr(loaded, name), array)
