"""The inertial prior: smooths what is noise, bends nothing that is constant, and is not there when off."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from temporal_scene import make_scene, preset, rotation_error_deg

from hat_ros.bench.methods.temporal import run_temporal
from hat_ros.core.inertia import InertialPrior
from hat_ros.geometry import lie

STEP = lie.transform(lie.so3_exp(np.array([0.02, -0.03, 0.01])), np.zeros(3))


def _trajectory(n, velocity_m=(0.01, 0.0, -0.02)):
    """A constant turn about the target's own origin, and a constant velocity."""
    R = [lie.so3_exp(i * lie.so3_log(STEP[:3, :3])) for i in range(n)]
    return [lie.transform(R[i], np.array([0.1, 0.2, 9.0]) + i * np.array(velocity_m)) for i in range(n)]


def _shaky(scene, seed, turn_deg=0.5, shift=0.004):
    """The same observations with noise on every SLAM pose."""
    rng = np.random.default_rng(seed)
    slam = scene.observations.slam.copy()
    noise = lie.so3_exp(np.radians(turn_deg) * rng.normal(size=(len(slam), 3)))
    slam = slam @ lie.transform(noise, shift * rng.normal(size=(len(slam), 3)))
    return replace(scene.observations, slam=slam)


def test_constant_rates_pass_unchanged():
    prior, T = InertialPrior(0.3, 0.1), _trajectory(30)
    for before, now in pairwise(T):
        np.testing.assert_allclose(prior.smooth(before, now), now, atol=1e-12)


def test_a_kick_is_shared_by_the_squares_of_the_weights():
    T = _trajectory(3)
    prior = InertialPrior(0.2, 0.1)
    prior.smooth(T[0], T[1])
    kick = lie.so3_exp(np.array([0.0, 0.01, 0.0]))
    kicked = lie.transform(kick @ T[2][:3, :3], T[2][:3, 3] + 0.05)
    smoothed = prior.smooth(T[1], kicked)
    assert lie.angle_between(smoothed[:3, :3], T[2][:3, :3]) == pytest.approx(0.2 * 0.01)
    np.testing.assert_allclose(smoothed[:3, 3] - T[2][:3, 3], 0.2 * 0.05, atol=1e-12)


def test_a_correction_by_an_anchor_is_no_velocity():
    prior, T = InertialPrior(0.1, 0.1), _trajectory(4)
    prior.smooth(T[0], T[1])
    correction = np.array([0.3, 0.0, 0.0])
    moved = [lie.transform(pose[:3, :3], pose[:3, 3] + correction) for pose in T]
    np.testing.assert_allclose(prior.smooth(moved[1], moved[2]), moved[2], atol=1e-12)
    np.testing.assert_allclose(prior.smooth(moved[2], moved[3]), moved[3], atol=1e-12)


def test_a_gap_in_the_motion_forgets_the_rates():
    prior, T = InertialPrior(10.0, 0.1), _trajectory(4)
    prior.smooth(T[0], T[1])
    prior.forget()
    np.testing.assert_array_equal(prior.smooth(T[1], T[3]), T[3])


@pytest.mark.parametrize("weights", [(0.0, 0.1), (1.0, 0.0)])
def test_without_weight_or_motion_there_is_no_prior(weights):
    prior, T = InertialPrior(*weights), _trajectory(3)
    assert prior.smooth(T[0], T[1]) is T[1]
    assert prior.smooth(T[1], T[0]) is T[0]


@pytest.mark.parametrize("name", ["mega_hat", "pico_hat"])
@pytest.mark.parametrize("gap", [4, 8])
def test_a_steady_target_under_noisy_motion_is_tracked_better(name, gap):
    off = preset(name, selector={"running_gate": False})
    on = replace(off, fusion=replace(off.fusion, inertial_weight=off.fusion.relative_weight))
    turn_deg, shift_m = ({"off": [], "on": []} for _ in range(2))
    for seed in range(2):
        scene = make_scene(140, gap=gap, seed=seed, noise_deg=0.5, competing_score=0.3)
        observations = _shaky(scene, seed)
        for label, config in (("off", off), ("on", on)):
            T = run_temporal(observations, config).T_cam_target[30:]
            turn_deg[label].append(rotation_error_deg(T, scene.T_cam_target[30:]).mean())
            shift_m[label].append(np.linalg.norm(T[:, :3, 3] - scene.T_cam_target[30:, :3, 3], axis=1).mean())
    assert np.mean(turn_deg["on"]) < 0.9 * np.mean(turn_deg["off"])
    assert np.mean(shift_m["on"]) < 0.9 * np.mean(shift_m["off"])


@pytest.mark.parametrize("name", ["default", "mega_hat", "pico_hat", "mega_hat_spark"])
def test_every_preset_has_it_off_as_published(name):
    assert preset(name).fusion.inertial_weight == 0.0


def test_off_gives_the_bits_of_a_tracker_that_never_heard_of_it(monkeypatch):
    scene = make_scene(80, noise_deg=3)
    config = preset("pico_hat")
    here = run_temporal(_shaky(scene, 0), config).T_cam_target
    monkeypatch.setattr(InertialPrior, "smooth", lambda self, output, predicted: predicted)
    np.testing.assert_array_equal(run_temporal(_shaky(scene, 0), config).T_cam_target, here)
