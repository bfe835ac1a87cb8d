import numpy as np
import pytest

from hat_ros.geometry import lie
from hat_ros.geometry.linear import cholesky_in_place, cholesky_solve, robust_mean_rotation, rotation

_CUTOFF_RAD = 0.05


def _around(R, angles_rad, seed):
    axes = np.random.default_rng(seed).normal(size=(len(angles_rad), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return lie.so3_exp(axes * np.asarray(angles_rad)[:, None]) @ R


@pytest.mark.parametrize("far_rad", [0.5, 2.0, np.pi])
def test_the_mean_stays_with_most_rotations_however_far_the_others_are(far_rad):
    R = lie.so3_exp(np.array([0.3, -2.0, 0.7]))
    rotations = np.concatenate([_around(R, [far_rad] * 4, 1), _around(R, [0.01] * 10, 2)])
    assert lie.angle_between(robust_mean_rotation(rotations, _CUTOFF_RAD), R) < 0.01


def test_the_mean_of_two_is_between_them_and_of_one_itself():
    R = lie.so3_exp(np.array([1.0, 0.2, -0.4]))
    step = lie.so3_exp(np.array([0.0, 0.01, 0.0]))
    mean = robust_mean_rotation(np.stack([step.T @ R, step @ R]), _CUTOFF_RAD)
    assert lie.angle_between(mean, R) < 1e-3
    np.testing.assert_allclose(robust_mean_rotation(R[None], _CUTOFF_RAD), R, atol=1e-12)


@pytest.mark.parametrize("n", [1, 3, 6, 8])
def test_cholesky_agrees_with_numpy(n):
    rng = np.random.default_rng(n)
    M = rng.normal(size=(n, n))
    A, b = M @ M.T + 0.1 * np.eye(n), rng.normal(size=n)
    L = np.tril(A)
    assert cholesky_in_place(L)
    np.testing.assert_allclose(cholesky_solve(L, b), np.linalg.solve(A, b), rtol=1e-8, atol=1e-10)


def test_cholesky_refuses_an_indefinite_matrix():
    assert not cholesky_in_place(np.diag([1.0, -1.0]))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, np.pi - 1e-6])
def test_rotation_agrees_with_the_core(angle):
    r = angle * np.array([0.6, -0.48, 0.64])
    np.testing.assert_allclose(rotation(r), lie.so3_exp(r), atol=1e-12)
