import numpy as np
import pytest

from hat_ros.target.contour import COL_INSIDE, COL_NU, COL_NV, COL_U, COL_V, COL_WEIGHT, COL_Z, contour_table

K = np.array([[100.0, 0, 40.0], [0, 100.0, 30.0], [0, 0, 1]])


def disc(radius, center=(40.3, 29.8)):
    y, x = np.mgrid[:60, :80]
    mask = (x - center[0]) ** 2 + (y - center[1]) ** 2 < radius**2
    return np.where(mask, 2.0, 0.0).astype(np.float32), mask


@pytest.mark.parametrize("max_points", [60, 1000])
def test_the_contour_of_a_disc(max_points):
    depth, mask = disc(20.0)
    table = contour_table(depth, mask, K, max_points)
    assert 20 < len(table) <= max_points
    radial = table[:, [COL_U, COL_V]] - [40.3, 29.8]
    distance = np.linalg.norm(radial, axis=1)
    assert distance.mean() == pytest.approx(20.0, abs=0.1)
    assert distance.std() < 0.2
    cosine = (radial * table[:, [COL_NU, COL_NV]]).sum(axis=1) / distance
    assert cosine.min() > 0.97
    assert table[:, COL_WEIGHT].sum() == pytest.approx(2 * np.pi * 20, rel=0.08)
    assert (table[:, COL_Z] == 2.0).all()
    assert table[:, COL_INSIDE].min() > 15


def test_points_lie_on_the_rays_of_their_pixels():
    depth, mask = disc(15.0)
    table = contour_table(depth, mask, K, 500)
    np.testing.assert_allclose(100 * table[:, 0] / table[:, 2] + 40, table[:, COL_U])
    np.testing.assert_allclose(100 * table[:, 1] / table[:, 2] + 30, table[:, COL_V])


def test_an_empty_view_has_no_contour():
    assert len(contour_table(np.zeros((20, 20), np.float32), np.zeros((20, 20), bool), K, 100)) == 0
