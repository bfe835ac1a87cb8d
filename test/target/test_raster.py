"""The affine numbers behind the rasteriser: weights, depth, what is hit and what is not."""

import numpy as np
import pytest

from hat_ros.target.raster import edge_functions, nearest_faces

K = np.array([[120.0, 0.0, 32.0], [0.0, 110.0, 24.0], [0.0, 0.0, 1.0]])
CENTRE = np.array([[0.5, 0.5]])
SIZE = (64, 48)


def faces_seen(corners, samples=CENTRE):
    corners = np.asarray(corners, dtype=np.float64)
    edges = edge_functions(corners, np.linalg.inv(K))
    return nearest_faces(corners, K, edges, samples, *SIZE)


def sheet(z, x0=-10.0, x1=10.0):
    """One triangle at depth z that covers everything between two x, or more."""
    return [[x0, -30.0, z], [x1, -30.0, z], [0.5 * (x0 + x1), 60.0, z]]


@pytest.mark.parametrize("seed", range(5))
def test_numbers_over_a_pixel_are_weights_and_inverse_depth(seed):
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1, 1, (1, 3, 3)) + [0, 0, 4]
    weights = rng.dirichlet(np.ones(3))
    point = weights @ corners[0]
    pixel = K @ point / point[2]
    b = edge_functions(corners, np.linalg.inv(K))[0] @ pixel
    assert b.sum() == pytest.approx(1 / point[2])
    np.testing.assert_allclose(b / b.sum(), weights, atol=1e-9)


def test_the_nearer_face_is_seen_whatever_the_order():
    near, far = sheet(2.0), sheet(3.0)
    assert (faces_seen([near, far]) == 0).all()
    assert (faces_seen([far, near]) == 1).all()


def test_both_sides_are_seen():
    assert (faces_seen([sheet(2.0)[::-1]]) == 0).all()


def test_what_is_behind_or_edge_on_is_not_seen():
    behind = sheet(-2.0)
    edge_on = [[0.0, -1.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 5.0]]
    assert (faces_seen([behind, edge_on]) == -1).all()
    assert (faces_seen(np.full((1, 3, 3), np.nan)) == -1).all()


def test_a_face_that_reaches_behind_the_camera_is_seen_in_front():
    floor = [[-50.0, 1.0, -50.0], [50.0, 1.0, -50.0], [0.0, 1.0, 80.0]]
    seen = faces_seen([floor])[..., 0]
    assert (seen[-1] == 0).all() and (seen[: SIZE[1] // 2] == -1).all()


def test_neighbours_leave_no_gap_and_samples_split_a_pixel():
    square = np.array([[-1.0, -1.0, 3.0], [1.0, -1.0, 3.0], [1.0, 1.0, 3.0], [-1.0, 1.0, 3.0]])
    seen = faces_seen([square[[0, 1, 2]], square[[0, 2, 3]]])[..., 0]
    u = (np.arange(SIZE[0]) + 0.5 - K[0, 2]) / K[0, 0] * 3
    v = (np.arange(SIZE[1]) + 0.5 - K[1, 2]) / K[1, 1] * 3
    np.testing.assert_array_equal(seen >= 0, (np.abs(v)[:, None] <= 1) & (np.abs(u)[None] <= 1))
    half = faces_seen([sheet(3.0, x1=3 * (10.5 - K[0, 2]) / K[0, 0])], np.array([[0.25, 0.5], [0.75, 0.5]]))
    assert half.shape == (*SIZE[::-1], 2)
