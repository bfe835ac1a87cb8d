import numpy as np
import pytest

from hat_ros import lie
from hat_ros.slam.linear import robust_mean_rotation

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
