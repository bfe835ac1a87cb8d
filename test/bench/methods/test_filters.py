"""The filters that can stand in Stage 3's place."""

from dataclasses import replace

import numpy as np
import pytest
from observed_log import CONFIG, observations

from hat_ros.bench.methods.filters import FilterNoise, ParticleSelector, UkfSelector
from hat_ros.bench.methods.temporal import replay_temporal
from hat_ros.core.selector import SelectorStage
from hat_ros.geometry import lie
from hat_ros.types import Candidates, Motion


@pytest.mark.parametrize("make", [ParticleSelector, UkfSelector, SelectorStage])
def test_selectors_resist_flips_and_answer_with_a_candidate(make):
    log = observations(flip_every=3)
    result = replay_temporal(log, CONFIG, make(CONFIG.selector))
    chosen = result.anchor[result.keyframe]
    assert set(chosen) <= {0, 1}
    assert np.nanmean(result.anchor_errors_deg()[20:] > 90) == 0.0


@pytest.mark.parametrize("make", [ParticleSelector, UkfSelector])
def test_filters_give_the_same_answer_every_time_and_do_not_depend_on_the_gauge(make):
    log = observations(flip_every=3)
    first = replay_temporal(log, CONFIG, make(CONFIG.selector))
    again = replay_temporal(log, CONFIG, make(CONFIG.selector))
    np.testing.assert_array_equal(first.pose_rows, again.pose_rows)
    other_gauge = lie.transform(lie.so3_exp(np.array([-1.0, 0.4, 2.0])), np.array([1.0, 1.0, 1.0]))
    rows = lie.row_from_matrix(other_gauge @ lie.matrix_from_row(log.motion_rows))
    moved = replay_temporal(replace(log, motion_rows=rows), CONFIG, make(CONFIG.selector))
    np.testing.assert_array_equal(first.anchor, moved.anchor)


@pytest.mark.parametrize("make", [ParticleSelector, UkfSelector])
def test_filters_go_on_without_motion_and_skip_empty_frames(make):
    log = observations(motion=False)
    selector = make(CONFIG.selector, FilterNoise(particles=200))
    assert selector.update(Candidates.none(), Motion.none()).selected == -1
    assert all(selector.update(group, Motion.none()).selected >= 0 for group in log.candidates)


def test_particles_stay_normalised_and_the_covariance_positive():
    log = observations(flip_every=3)
    particles, ukf = ParticleSelector(CONFIG.selector, FilterNoise(particles=300)), UkfSelector(CONFIG.selector)
    for i, group in enumerate(log.candidates):
        particles.update(group, log.motion(i))
        ukf.update(group, log.motion(i))
    assert particles._weight.sum() == pytest.approx(1.0)
    assert lie.is_rigid(lie.transform(particles._R, np.zeros((300, 3)))).all()
    assert np.linalg.eigvalsh(ukf._covariance).min() > 0
