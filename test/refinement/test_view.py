import cv2
import numpy as np
import pytest
from shape_scene import CAMERA, random_pose, spacecraft

from hat_ros.geometry import lie
from hat_ros.refinement.mask_field import MaskField
from hat_ros.refinement.pose_fitter import PoseFitter
from hat_ros.refinement.view import TargetViewer
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.silhouette import spread_grid
from hat_ros.types import Camera

BLACK = np.zeros((CAMERA.height, CAMERA.width), np.uint8)


@pytest.fixture(scope="module")
def viewer():
    return TargetViewer(spacecraft())


@pytest.mark.parametrize("seed", range(5))
def test_the_silhouette_is_that_of_the_renderer(viewer, seed):
    T = random_pose(np.random.default_rng(seed), viewer.target)
    view = viewer.view(T, CAMERA, 160)
    full = RayRenderer(viewer.target).render(T, view.camera, color=False)
    assert np.count_nonzero(view.mask != full.mask) <= 0.002 * np.count_nonzero(full.mask)


@pytest.mark.parametrize("shift_px", [(30, -20), (-60, 10)])
def test_centring_finds_a_target_that_has_drifted(viewer, shift_px):
    T_true = random_pose(np.random.default_rng(6), viewer.target)
    field = MaskField(RayRenderer(viewer.target).render(T_true, CAMERA, color=False).mask)
    start = T_true.copy()
    start[:2, 3] += np.array(shift_px) * T_true[2, 3] / CAMERA.K[0, 0]
    centred = PoseFitter(viewer, 160, 300).centred(start, CAMERA, field, BLACK)
    assert np.abs(centred[:2, 3] - T_true[:2, 3]).max() < 4 * T_true[2, 3] / CAMERA.K[0, 0]
    np.testing.assert_array_equal(centred[:3, :3], T_true[:3, :3])


def test_out_of_view_is_none(viewer):
    assert viewer.view(lie.transform(np.eye(3), np.array([0.0, 0.0, -5.0])), CAMERA, 96) is None
    assert viewer.view(np.full((4, 4), np.nan), CAMERA, 96) is None
    aside = viewer.view(lie.transform(np.eye(3), np.array([40.0, 0.0, 5.0])), CAMERA, 96)
    assert aside is None or not aside.mask.any()


def test_a_large_image_costs_no_larger_crop(viewer):
    camera = Camera(np.array([[4000.0, 0, 2000], [0, 4000.0, 1500], [0, 0, 1]]), 4000, 3000)
    view = viewer.view(random_pose(np.random.default_rng(0), viewer.target), camera, 96)
    assert max(view.mask.shape) <= 102


@pytest.mark.parametrize("seed", range(5))
def test_outline_pixels_are_those_of_blocks_next_to_the_other_side(seed):
    rng = np.random.default_rng(seed)
    rows, cols = 9, 13
    hit = cv2.GaussianBlur(rng.random((rows, cols)), (0, 0), 1.5) > 0.5
    face = np.where(hit, rng.integers(0, 100, hit.shape), -1).astype(np.int32).ravel()
    mask, depth, x, y = spread_grid(face, np.arange(face.size, dtype=np.float32), 2 * cols, 2 * rows)
    np.testing.assert_array_equal(mask, np.kron(hit, np.ones((2, 2), bool)))
    np.testing.assert_array_equal(depth[::2, ::2].ravel(), np.arange(face.size))
    around = np.pad(hit, 1)  # beyond the crop nothing is hit
    windows = np.lib.stride_tricks.sliding_window_view(around, (3, 3))
    inner = np.lib.stride_tricks.sliding_window_view(np.pad(hit, 1, mode="edge"), (3, 3))
    mixed = inner.any(axis=(2, 3)) & ~windows.all(axis=(2, 3))
    expected = np.kron(mixed, np.array([[0, 1], [1, 1]], bool))
    asked = np.zeros_like(expected)
    asked[y, x] = True
    np.testing.assert_array_equal(asked, expected)
    assert len(x) == expected.sum(), "no pixel twice"
