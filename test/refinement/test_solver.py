import numpy as np
import pytest

from hat_ros import lie
from hat_ros.refinement.solver import cholesky_solve, edge_offset, rotation_exp


@pytest.mark.parametrize("n", [1, 6, 8])
def test_cholesky_agrees_with_numpy(n):
    rng = np.random.default_rng(n)
    M = rng.normal(size=(n, n))
    A, b = M @ M.T + 0.1 * np.eye(n), rng.normal(size=n)
    ok, x = cholesky_solve(A, b)
    assert ok
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-8, atol=1e-10)


def test_cholesky_refuses_an_indefinite_matrix():
    assert not cholesky_solve(np.diag([1.0, -1.0]), np.ones(2))[0]


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, np.pi - 1e-6])
def test_rotation_agrees_with_the_core(angle):
    r = angle * np.array([0.6, -0.48, 0.64])
    np.testing.assert_allclose(rotation_exp(r), lie.so3_exp(r), atol=1e-12)


@pytest.mark.parametrize("position", [20.0, 20.3, 21.7])
@pytest.mark.parametrize("levels", [(200, 0), (90, 160)])
def test_an_edge_is_found_at_its_half_level(position, levels):
    inside, outside = levels
    x = np.arange(40)
    share = np.clip(position + 0.5 - x, 0, 1)  # of pixel x covered by the target on the left
    row = np.rint(inside * share + outside * (1 - share)).astype(np.uint8)
    image = np.repeat(np.repeat(row[None, :, None], 20, axis=0), 3, axis=2)
    offset, quality = edge_offset(image, 20.0, 10.0, 1.0, 0.0, 6.0, 6.0, 0.75, np.empty((64, 3)), np.empty(64))
    assert offset == pytest.approx(position - 20.0, abs=0.2)
    assert quality > 0.7


def test_an_even_image_has_no_edge():
    image = np.full((20, 40, 3), 77, np.uint8)
    _, quality = edge_offset(image, 20.0, 10.0, 1.0, 0.0, 4.0, 4.0, 0.5, np.empty((64, 3)), np.empty(64))
    assert quality == 0.0
