import numpy as np
import pytest
from shape_scene import CAMERA, random_pose, spacecraft

from hat_ros.refinement.mask_field import MaskField
from hat_ros.refinement.view import TargetViewer
from hat_ros.target.ray_renderer import RayRenderer

BLACK = np.zeros((CAMERA.height, CAMERA.width), np.uint8)


@pytest.fixture(scope="module")
def viewer():
    return TargetViewer(spacecraft())


def test_the_true_pose_overlaps_its_own_mask(viewer):
    T = random_pose(np.random.default_rng(2), viewer.target)
    mask = RayRenderer(viewer.target).render(T, CAMERA, color=False).mask
    field = MaskField(mask)
    areas = field.compare(viewer.view(T, CAMERA, 160), BLACK)
    assert areas.union_share > 0.96
    assert areas.common + areas.extra == pytest.approx(np.count_nonzero(mask))
    assert field.compare(viewer.view(T, CAMERA, 160), BLACK, tolerance_px=1.0).extra < 2.0


def test_what_lies_outside_the_image_counts_nowhere(viewer):
    T = random_pose(np.random.default_rng(2), viewer.target, range_m=(5.0, 5.2))
    T[0, 3] += 1.3
    mask = RayRenderer(viewer.target).render(T, CAMERA, color=False).mask
    assert mask[:, -1].any()
    assert MaskField(mask).compare(viewer.view(T, CAMERA, 160), BLACK).union_share > 0.95


def test_the_field_measures_pixels_from_the_outline():
    mask = np.zeros((60, 80), bool)
    mask[20:40, 30:60] = True
    field = MaskField(mask)
    x0, y0 = field.origin_px.astype(int)
    assert field.distance[30 - y0, 25 - x0] == pytest.approx(4.5, abs=0.1)
    assert field.distance[30 - y0, 33 - x0] == pytest.approx(-3.5, abs=0.1)
    assert field.centroid_px == pytest.approx([44.5, 29.5])
    assert field.area_px == 600
