import numpy as np

from hat_ros.geometry import lie
from hat_ros.refinement.covariance import OUTLINE_SIGMA_PX, USUAL_MISFIT_PX, outline_floor, outline_misfit_px
from hat_ros.refinement.mask_field import Overlap


def test_an_outline_too_wide_all_around_is_a_depth_error():
    T = lie.transform(np.eye(3), np.array([0.0, 0.0, 10.0]))
    floor = outline_floor(T, focal_px=1000.0, radius_m=1.0)
    apparent_radius_px = 100.0
    assert np.isclose(np.sqrt(floor[2, 2]), 10.0 * OUTLINE_SIGMA_PX / apparent_radius_px, rtol=1e-2)
    assert np.isclose(np.sqrt(floor[0, 0]), OUTLINE_SIGMA_PX * 10.0 / 1000.0)
    assert np.isclose(np.sqrt(floor[3, 3]), OUTLINE_SIGMA_PX / apparent_radius_px)


def test_the_floor_follows_the_line_of_sight():
    T = lie.transform(np.eye(3), np.array([3.0, 0.0, 4.0]))
    values, vectors = np.linalg.eigh(outline_floor(T, 1000.0, 1.0)[:3, :3])
    np.testing.assert_allclose(np.abs(vectors[:, -1]), [0.6, 0.0, 0.8], atol=1e-12)
    assert values[-1] > 10 * values[0]


def test_the_misfit_is_the_mean_distance_of_outlines_beyond_the_usual():
    areas = Overlap(common=1000.0, extra=100.0, missing=150.0, hidden=50.0)
    assert outline_misfit_px(areas, 100.0) == 2.5 - USUAL_MISFIT_PX
    assert outline_misfit_px(Overlap(1000.0, 10.0, 0.0, 0.0), 100.0) == 0.0
