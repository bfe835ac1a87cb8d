import numpy as np
import pytest
from shape_scene import CAMERA, random_pose, spacecraft

from hat_ros.geometry import lie
from hat_ros.refinement.view import TargetViewer
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.types import Camera


@pytest.fixture(scope="module")
def viewer():
    return TargetViewer(spacecraft())


@pytest.mark.parametrize("seed", range(5))
def test_the_silhouette_is_that_of_the_renderer(viewer, seed):
    T = random_pose(np.random.default_rng(seed), viewer.target)
    view = viewer.view(T, CAMERA, 160)
    full = RayRenderer(viewer.target).render(T, view.camera, color=False)
    assert np.count_nonzero(view.mask != full.mask) <= 0.002 * np.count_nonzero(full.mask)


def test_out_of_view_is_none(viewer):
    assert viewer.view(lie.transform(np.eye(3), np.array([0.0, 0.0, -5.0])), CAMERA, 96) is None
    assert viewer.view(np.full((4, 4), np.nan), CAMERA, 96) is None
    aside = viewer.view(lie.transform(np.eye(3), np.array([40.0, 0.0, 5.0])), CAMERA, 96)
    assert aside is None or not aside.mask.any()


def test_a_large_image_costs_no_larger_crop(viewer):
    camera = Camera(np.array([[4000.0, 0, 2000], [0, 4000.0, 1500], [0, 0, 1]]), 4000, 3000)
    view = viewer.view(random_pose(np.random.default_rng(0), viewer.target), camera, 96)
    assert max(view.mask.shape) <= 102
