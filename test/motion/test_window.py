import numpy as np
import pytest

from hat_ros.config import FeatureSlamConfig
from hat_ros.geometry import lie
from hat_ros.geometry.linear import turn_between
from hat_ros.motion.window import Window

_FRAME_NS = 100_000_000
_RADIUS, _FOCAL, _N = 0.02, 1000.0, 40
_STEP = np.radians([0.3, -0.5, 0.2])


def _points():
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(_N, 3))
    return _RADIUS * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _rotation(i):
    return lie.so3_exp(i * _STEP)


def _image(points, R, t):
    in_camera = points @ R.T + t
    return in_camera[:, :2] / in_camera[:, 2:]


@pytest.fixture
def wrong_window():
    """A window that sees a body turn as it does and believes that it turns the other way, four times as fast."""
    points, t = _points(), np.array([0.0, 0.0, 1.0])
    config = FeatureSlamConfig(max_points=_N)
    window = Window(config, 0, np.zeros(2), _RADIUS, _FOCAL)
    every, seen = np.arange(_N), np.ones(_N, bool)
    window.place(every, _image(points, np.eye(3), t), np.ones(_N), 10 * _RADIUS)
    for i in range(1, 10):
        R_wrong = lie.so3_exp(-4 * i * _STEP)
        window.append(i * _FRAME_NS, R_wrong, t, _image(points, _rotation(i), t), seen)
    window.X = window.X_guess = np.column_stack([points[:, :2], -0.25 * points[:, 2]])
    window.number = [n + 20 for n in window.number]
    return window


def test_a_surface_that_explains_the_tracks_is_believed_however_wrong_the_motion_was(wrong_window):
    """Its oldest frame must be free to stand elsewhere: the gauge belongs to a solution, not to the tracks."""
    window, look = wrong_window, 5
    in_camera = _points() @ _rotation(look).T + window.t[look]
    window.X_surface = (in_camera - window.t[look]) @ window.R[look]
    window.n_looks[:] = 1
    window.surface_info[:] = (0.05 * _RADIUS) ** -2
    window.look_stamp_ns = look * _FRAME_NS
    window.try_prior()
    assert window.trusts_prior
    turn = turn_between(window.R[-1], window.R[0])
    assert np.linalg.norm(turn - 9 * _STEP) < np.radians(0.5)


def test_a_trusted_surface_is_not_left_for_the_reversed_relief_because_that_is_free_of_it(wrong_window):
    """Seen from afar both fit once they are free, and the present one is what the fused poses follow."""
    window = wrong_window
    window.R = np.stack([_rotation(i) for i in range(10)])
    window.X = _points() + np.random.default_rng(1).normal(scale=0.1 * _RADIUS, size=(_N, 3))
    window.X_guess = window.X.copy()
    window.trusts_prior = True
    before = window.R.copy()
    window.challenge_structure()
    assert window.trusts_prior
    assert np.array_equal(window.R, before)


def test_a_common_turn_of_all_poses_and_points_costs_nothing(wrong_window):
    window, turn = wrong_window, lie.so3_exp(np.array([0.4, -0.2, 0.7]))
    here = window._free_cost(window.R, window.t, window.X)
    window.X_guess = window.X_guess @ turn
    assert window._free_cost(window.R @ turn, window.t, window.X @ turn) == pytest.approx(here, rel=1e-9)
