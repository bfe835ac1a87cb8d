"""``hat temporal`` with the paper's presets against the method written down once more, on twelve recorded clips."""

from dataclasses import replace

import numpy as np
import published_oracle
import pytest
from temporal_scene import HALF_TURN, make_scene, preset

from hat_ros.bench.methods.temporal import run_temporal
from hat_ros.geometry import lie

GAPS = {"mega_hat": 4, "pico_hat": 6, "mega_hat_spark": 10}


def _noisy(o, gap, rng):
    return o


def _reset_in_the_middle(o, gap, rng):
    """From the middle on all candidates are in a basin half a turn away."""
    poses = o.poses.copy()
    middle = len(o) // 2
    poses[middle:, :, :3, :3] = poses[middle:, :, :3, :3] @ HALF_TURN
    return replace(o, poses=poses)


def _outliers_at_refits(o, gap, rng):
    """Every third keyframe all candidates are far off, refits or not: the fit has to take them as they are."""
    poses = o.poses.copy()
    for frame in np.flatnonzero(o.key)[4::3]:
        turn = lie.so3_exp(rng.normal(size=3) * 0.9)
        poses[frame, :, :3, :3] = poses[frame, :, :3, :3] @ turn
        poses[frame, :, :3, 3] += rng.normal(size=3) * 0.8
    return replace(o, poses=poses)


def _long_gap(o, gap, rng):
    """Nothing at all for longer than the default preset waits, then motion alone, then anchors again."""
    key, slam = o.key.copy(), o.slam.copy()
    start = len(o) // 3
    key[start : start + 75], slam[start : start + 65] = False, np.nan
    return replace(o, key=key, slam=slam)


WHAT = {
    "noise": _noisy,
    "reset in the middle": _reset_in_the_middle,
    "outliers at refits": _outliers_at_refits,
    "long gap": _long_gap,
}


@pytest.mark.parametrize("what", WHAT)
@pytest.mark.parametrize("name", GAPS)
def test_it_is_the_published_method(name, what):
    gap, n = GAPS[name], 40 * GAPS[name]
    scene = make_scene(n, gap=gap, seed=len(name + what), noise_deg=4, noise_m=0.05, rate_deg=0.8)
    recorded = WHAT[what](scene.observations, gap, np.random.default_rng(7))
    config = preset(name)
    ours = run_temporal(recorded, config)
    T, chosen, resets = published_oracle.run(recorded, config)
    np.testing.assert_array_equal(ours.chosen, chosen)
    np.testing.assert_array_equal(ours.resets, resets)
    assert np.isfinite(ours.T_cam_target).all()
    turn_deg = np.degrees(lie.angle_between(ours.T_cam_target[:, :3, :3], T[:, :3, :3]))
    shift_m = np.linalg.norm(ours.T_cam_target[:, :3, 3] - T[:, :3, 3], axis=1)
    print(f"{name}, {what}: {turn_deg.max():.1e} deg, {1e3 * shift_m.max():.1e} mm, resets {list(resets)}")
    # scipy stops at the root of the machine precision of its cost.
    assert turn_deg.max() < 1e-4
    assert shift_m.max() < 1e-5
