"""Bundle adjustment on planted points: laws of the estimator, without images."""

import numpy as np
import pytest

from hat_ros.geometry import lie
from hat_ros.geometry.linear import rotation, turn_between
from hat_ros.motion.bundle import Problem, adjust_window, window_cost
from hat_ros.motion.reprojection import refine_pose

FOCAL = 1000.0


def planted(n_frames=10, n_points=60, step_deg=4.0, seed=0):
    """R, t, X and exact observations of a ball of points that turns at a constant rate in front of the camera."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n_points, 3)) * 0.08
    turns = lie.so3_exp(np.radians(step_deg) * np.arange(n_frames)[:, None] * np.array([0.3, 0.9, 0.3]))
    t = np.array([0.02, -0.01, 1.0]) + np.linspace(0, 1, n_frames)[:, None] * np.array([0.03, 0.02, -0.05])
    in_camera = X @ np.swapaxes(turns, 1, 2) + t[:, None]
    return turns, t, X, in_camera[..., :2] / in_camera[..., 2:]


def problem(R, t, X, xn, **changes):
    W, N = xn.shape[:2]
    values = {
        "xn": xn, "seen": np.ones((W, N), dtype=bool), "focal": FOCAL, "sigma_px": 1.0, "cutoff_px": 3.0,
        "X_expected": X.copy(), "X_info": np.zeros(N), "R_expected": R.copy(), "R_info": np.zeros(W),
        "dt": np.full(W, 0.1), "rate_info": np.full((W, 2), 1e-6), "R_gauge": R[0].copy(), "t_gauge": t[0].copy(),
        "gauge_info": 1e4,
    }  # fmt: skip
    return Problem(**(values | changes))


def disturbed(R, t, X, seed=1, turn=0.03, move=0.01, shift=0.02):
    rng = np.random.default_rng(seed)
    R = lie.so3_exp(turn * rng.normal(size=(len(R), 3))) @ R
    return R, t + move * rng.normal(size=t.shape), X + shift * rng.normal(size=X.shape)


def increments(R):
    return R[1:] @ np.swapaxes(R[:-1], 1, 2)


@pytest.mark.parametrize("angle", [1e-9, 1e-4, 0.3, 3.0])
def test_rotation_and_turn_between_are_inverse(angle):
    v = angle * np.array([0.6, -0.64, 0.48])
    np.testing.assert_allclose(rotation(v), lie.so3_exp(v), atol=1e-14)
    np.testing.assert_allclose(turn_between(rotation(v) @ rotation(v), rotation(v)), v, rtol=1e-9, atol=1e-12)


def test_planted_motion_is_recovered_up_to_similarity():
    R_true, t_true, X_true, xn = planted()
    R, t, X = disturbed(R_true, t_true, X_true)
    p = problem(R, t, X, xn)
    for _ in range(5):
        cost, _ = adjust_window(R, t, X, p, 30)
    assert cost < 1e-2
    np.testing.assert_allclose(lie.angle_between(increments(R), increments(R_true)), 0, atol=1e-3)


def test_a_quarter_of_tracks_that_slide_together_does_not_pull_the_motion():
    R_true, t_true, X_true, xn = planted(n_points=80)
    xn[:, :20] += np.arange(len(xn))[:, None, None] * np.array([4.0, -3.0]) / FOCAL
    R, t, X = disturbed(R_true, t_true, X_true, turn=0.005, move=0.002, shift=0.005)
    for cutoff_px in (16.0, 8.0, 4.0, 2.0, 1.0):
        adjust_window(R, t, X, problem(R, t, X, xn, cutoff_px=cutoff_px), 30)
    assert np.degrees(lie.angle_between(increments(R), increments(R_true))).max() < 0.2


def test_cost_never_rises_and_is_what_window_cost_says():
    R, t, X, xn = planted()
    R, t, X = disturbed(R, t, X)
    p = problem(R, t, X, xn, X_info=np.full(60, 10.0), R_info=np.full(10, 100.0))
    before = window_cost(R, t, X, p)
    for _ in range(4):
        cost, _ = adjust_window(R, t, X, p, 2)
        assert cost <= before
        assert cost == window_cost(R, t, X, p)
        before = cost


def test_points_that_nothing_sees_stay_put():
    R, t, X, xn = planted()
    R, t, X = disturbed(R, t, X)
    p = problem(R, t, X, xn)
    p.seen[:, 7] = False
    kept = X[7].copy()
    adjust_window(R, t, X, p, 5)
    np.testing.assert_array_equal(X[7], kept)


def test_expected_rotations_pull_and_a_wild_one_does_not():
    R_true, t_true, X_true, xn = planted()
    R, t, X = disturbed(R_true, t_true, X_true, turn=0.005)
    expected, info = R_true.copy(), np.full(len(R), 1e6)
    expected[4] = lie.so3_exp(np.array([0.0, 2.5, 0.0])) @ expected[4]
    p = problem(R, t, X, xn, R_expected=expected, R_info=info)
    for _ in range(3):
        adjust_window(R, t, X, p, 30)
    assert np.degrees(lie.angle_between(R, R_true)).max() < 0.2


def test_constant_rate_prior_carries_a_frame_without_observations():
    R_true, t_true, X_true, xn = planted()
    R, t, X = R_true.copy(), t_true.copy(), X_true.copy()
    R[-1] = lie.so3_exp(np.array([0.05, 0.02, 0.0])) @ R[-1]
    p = problem(R, t, X, xn, rate_info=np.full((len(R), 2), 1e6))
    p.seen[-1] = False
    for _ in range(3):
        adjust_window(R, t, X, p, 30)
    assert np.degrees(lie.angle_between(R[-1], R_true[-1])) < 0.05


def test_covariance_shrinks_with_more_points():
    sigma = []
    for n_points in (15, 150):
        R, t, X, xn = planted(n_points=n_points)
        R, t, X = disturbed(R, t, X, turn=0.002, move=0.001, shift=0.001)
        _, covariance = adjust_window(R, t, X, problem(R, t, X, xn), 5)
        assert np.isfinite(covariance).all()
        sigma.append(np.sqrt(np.trace(covariance[6:9, 6:9])))
    assert sigma[1] < 0.6 * sigma[0]


def test_same_input_gives_the_same_bytes():
    results = []
    for _ in range(2):
        R, t, X, xn = planted()
        R, t, X = disturbed(R, t, X)
        adjust_window(R, t, X, problem(R, t, X, xn), 5)
        results.append(R.tobytes() + t.tobytes() + X.tobytes())
    assert results[0] == results[1]


def test_one_pose_from_known_points_ignores_outliers():
    R_true, t_true, X, xn = planted()
    observed = xn[3].copy()
    observed[:15] += 0.05
    R0 = lie.so3_exp(np.array([0.03, -0.02, 0.04])) @ R_true[3]
    R, t, residual_px = refine_pose(
        R0, t_true[3] + 0.004, X, observed, np.ones(len(X), dtype=bool), FOCAL, 1.0, 6.0, R0, t_true[3], 1.0, 1.0, 30
    )
    assert np.degrees(lie.angle_between(R, R_true[3])) < 0.02
    np.testing.assert_allclose(t, t_true[3], atol=1e-3)
    assert (residual_px[:15] > 20).all()
    assert (residual_px[15:] < 0.5).all()


def test_points_behind_the_camera_and_unused_ones_have_no_residual():
    R, t, X, xn = planted()
    X[0] = [0, 0, -5.0]
    use = np.ones(len(X), dtype=bool)
    use[1] = False
    *_, residual_px = refine_pose(R[0], t[0], X, xn[0], use, FOCAL, 1.0, 6.0, R[0], t[0], 1.0, 1.0, 3)
    assert np.isinf(residual_px[:2]).all()
    assert np.isfinite(residual_px[2:]).all()
