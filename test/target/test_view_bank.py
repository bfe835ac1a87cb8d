import numpy as np
import pytest
import trimesh
from shape_scene import spacecraft

from hat_ros.cache import cache_folder
from hat_ros.geometry import lie
from hat_ros.target import view_bank
from hat_ros.target.loading import target_from_scene
from hat_ros.target.masks import mask_moments
from hat_ros.target.ray_renderer import RayRenderer


@pytest.fixture(scope="module")
def target():
    return spacecraft()


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def test_a_damaged_cache_is_built_again(target):
    renderer = RayRenderer(target)
    first = view_bank.load_or_build(target, renderer, 162, 24)
    spectrum = np.array(first.spectrum)
    file = next(cache_folder().rglob("spectrum.npy"))
    content = bytearray(file.read_bytes())
    content[-9] ^= 255
    file.write_bytes(content)
    again = view_bank.load_or_build(target, renderer, 162, 24)
    assert again.spectrum.tobytes() == spectrum.tobytes()
    assert again.n_angles == 24


def test_a_read_only_cache_is_no_error(target, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert view_bank.load_or_build(target, RayRenderer(target), 162, 24).area.shape == (162,)


def test_contour_points_lie_on_the_target(target):
    views = view_bank.build(target, RayRenderer(target), 162, 24)
    used = views.contour_weight > 0
    points = views.contour_m[used]
    low, high = target.vertices_m.min(axis=0), target.vertices_m.max(axis=0)
    assert (points > low - 0.05).all() and (points < high + 0.05).all()
    assert used.sum(axis=1).min() > 20


def _body_and_boom(scale, boom_px):
    """A body of 60 x 40 pixels, and a boom of some width three times as far out; both magnified."""
    mask = np.zeros((120 * scale, 200 * scale), np.bool_)
    mask[40 * scale : 80 * scale, 20 * scale : 80 * scale] = True
    with_boom = mask.copy()
    with_boom[60 * scale : 60 * scale + boom_px, 80 * scale : 180 * scale] = True
    return mask, with_boom


@pytest.mark.parametrize("scale", [1, 3])
def test_a_boom_is_left_out_at_any_magnification(scale):
    mask, with_boom = _body_and_boom(scale, boom_px=2 * scale)
    np.testing.assert_array_equal(view_bank.without_thin_parts(with_boom)[:, 85 * scale :], False)
    kept = view_bank.without_thin_parts(with_boom) & mask
    assert kept.sum() > 0.98 * mask.sum()


def test_what_is_as_wide_as_a_panel_is_kept_and_so_is_a_body_that_is_thin_all_over():
    panel = _body_and_boom(1, boom_px=12)[1]
    assert view_bank.without_thin_parts(panel).sum() > 0.97 * panel.sum()
    edge_on = np.zeros((120, 200), np.bool_)
    edge_on[60:62, 20:180] = True
    np.testing.assert_array_equal(view_bank.without_thin_parts(edge_on), edge_on)


def test_a_mask_without_the_boom_has_the_moments_of_the_view_with_it():
    mask, with_boom = _body_and_boom(1, boom_px=2)
    seen, shown = (mask_moments(view_bank.without_thin_parts(m)) for m in (mask, with_boom))
    np.testing.assert_allclose(shown.center_px, seen.center_px, atol=0.5)
    assert shown.gyration_px == pytest.approx(seen.gyration_px, rel=0.02)
    assert mask_moments(with_boom).gyration_px > 1.2 * seen.gyration_px  # so much the boom would have changed it


def test_a_bank_without_thin_parts_describes_the_body_that_carries_them():
    body = trimesh.creation.box((1.0, 0.7, 0.5))
    boom = trimesh.creation.cylinder(0.013, 1.6, transform=lie.transform(np.eye(3), [0.0, 0.0, 0.8]))
    whole = target_from_scene(trimesh.Scene([body, boom]), "with a boom")
    renderer = RayRenderer(whole)
    with_boom, without = (view_bank.build(whole, renderer, 162, 24, thin_parts) for thin_parts in (True, False))
    on_boom = [
        np.where(views.contour_m[..., 2] > 0.6, views.contour_weight, 0.0).sum(axis=1) for views in (with_boom, without)
    ]
    assert on_boom[1].sum() < 0.25 * on_boom[0].sum()  # a grid lets some diagonal ones through
    rid = (on_boom[0] > 0) & (on_boom[1] == 0)
    assert rid.mean() > 0.5
    assert (without.gyration[rid] < with_boom.gyration[rid]).all()
