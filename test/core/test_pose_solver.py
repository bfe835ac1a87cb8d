"""The 6-DoF robust solve against generic optimisers."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize

from hat_ros.core.pose_solver import PoseProblem, solve_pose
from hat_ros.geometry import lie


def _problem(seed, apart_deg, apart_m, anchor_weight=1.0, relative_weight=0.1, delta=0.3):
    rng = np.random.default_rng(seed)
    predicted = lie.transform(lie.so3_exp(rng.normal(size=3)), np.array([0.2, -0.1, 6.0]) + rng.normal(size=3))
    axis, direction = rng.normal(size=(2, 3))
    turn = lie.so3_exp(np.radians(apart_deg) * axis / np.linalg.norm(axis))
    anchor = lie.transform(turn @ predicted[:3, :3], predicted[:3, 3] + apart_m * direction / np.linalg.norm(direction))
    return PoseProblem(anchor, anchor_weight, predicted, relative_weight, 1.0, delta)


def _by_scipy(problem, start):
    """Eq. (causalfusion) over a rotation vector about ``start`` and a translation, by scipy."""

    def residuals(x):
        return problem.residuals(lie.so3_exp(x[:3]) @ start[:3, :3], start[:3, 3] + x[3:])

    loss = {} if problem.huber_delta_m is None else {"loss": "huber", "f_scale": problem.huber_delta_m}
    found = scipy.optimize.least_squares(residuals, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15, **loss)

    def cost(x):
        return problem.cost(residuals(x)) * 1e6

    polished = scipy.optimize.minimize(cost, found.x, method="BFGS", options={"gtol": 1e-12})
    return min(problem.cost(residuals(found.x)), problem.cost(residuals(polished.x))), found.x


CASES = [
    (5, 0.05, 1.0, 0.1, 0.3),
    (25, 0.2, 1.0, 0.1, 0.3),
    (60, 1.0, 1.0, 0.1, 0.3),
    (20, 0.5, 1.0, 0.002, 0.3),
    (120, 2.0, 0.05, 0.1, 0.3),
    (150, 0.5, 0.05, 0.002, 0.3),
    (40, 2.0, 1.0, 0.8, 0.3),
    (40, 2.0, 1.0, 1.0, None),
    (100, 1.0, 0.05, 0.1, None),
]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("case", CASES, ids=str)
def test_it_finds_the_optimum_that_scipy_finds(case, seed):
    apart_deg, apart_m, anchor_weight, relative_weight, delta = case
    problem = _problem(seed, apart_deg, apart_m, anchor_weight, relative_weight, delta)
    ours = solve_pose(problem)
    best, _ = _by_scipy(problem, problem.predicted)
    cost = problem.cost(problem.residuals(ours[:3, :3], ours[:3, 3]))
    assert cost <= best * (1 + 1e-9) + 1e-15
    # From our answer a generic optimiser has nowhere to go.
    _, step = _by_scipy(problem, ours)
    np.testing.assert_allclose(step, 0.0, atol=2e-7)
    np.testing.assert_allclose(problem.gradient(ours[:3, :3], ours[:3, 3]), 0.0, atol=1e-11)


@pytest.mark.parametrize("seed", range(5))
def test_where_the_problem_is_quadratic_it_agrees_to_nine_digits(seed):
    problem = replace(_problem(seed, 3, 0.05, relative_weight=0.1), huber_delta_m=10.0)
    ours, start = solve_pose(problem), problem.predicted
    _, found = _by_scipy(problem, start)
    np.testing.assert_allclose(lie.so3_exp(found[:3]) @ start[:3, :3], ours[:3, :3], atol=1e-9)
    np.testing.assert_allclose(start[:3, 3] + found[3:], ours[:3, 3], atol=1e-9)


@pytest.mark.parametrize("apart_deg", [0.0, 30.0, 179.0])
def test_the_jacobian_is_the_derivative(apart_deg):
    problem = _problem(2, apart_deg, 0.5)
    R, t = lie.so3_exp(np.array([0.05, -0.02, 0.01])) @ problem.predicted[:3, :3], problem.predicted[:3, 3] + 0.1
    J, h = problem.jacobian(R, t, problem.residuals(R, t)), 1e-6
    for i in range(6):
        step = np.zeros(6)
        step[i] = h
        ahead = problem.residuals(lie.so3_exp(step[:3]) @ R, t + step[3:])
        behind = problem.residuals(lie.so3_exp(-step[:3]) @ R, t - step[3:])
        np.testing.assert_allclose(J[:, i], (ahead - behind) / (2 * h), atol=1e-6)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("apart_deg", [179.0, 179.999, 180.0])
def test_half_a_turn_apart_it_still_goes_downhill_to_rest(seed, apart_deg):
    problem = _problem(seed, apart_deg, 0.3)
    ours = solve_pose(problem)
    start = problem.cost(problem.residuals(problem.predicted[:3, :3], problem.predicted[:3, 3]))
    assert lie.is_rigid(ours, 1e-12)
    assert problem.cost(problem.residuals(ours[:3, :3], ours[:3, 3])) <= start


def test_agreeing_measurements_are_returned():
    problem = _problem(0, 0, 0)
    np.testing.assert_allclose(solve_pose(problem), problem.anchor, atol=1e-14)


def test_a_heavier_side_wins():
    anchor_led = solve_pose(_problem(0, 10, 0.1, 1.0, 0.002))
    np.testing.assert_allclose(anchor_led, _problem(0, 10, 0.1).anchor, atol=1e-4)
    motion_led = solve_pose(_problem(0, 10, 0.1, 0.001, 1.0))
    np.testing.assert_allclose(motion_led, _problem(0, 10, 0.1).predicted, atol=1e-4)
