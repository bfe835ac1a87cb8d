"""Which candidates may compete, and what a strict estimator is told."""

import numpy as np
import pytest

from hat_ros.core.guard import candidates_from_recording, guard_candidates
from hat_ros.errors import CandidateError
from hat_ros.geometry import lie


def _poses(depths):
    R = lie.so3_exp(np.random.default_rng(0).normal(size=(len(depths), 3)))
    return lie.transform(R, np.array([[0.1, -0.2, z] for z in depths]))


def _guarded(T, score, drop=True):
    return guard_candidates(candidates_from_recording(T, np.asarray(score, float)), drop)


def _kept(T, score):
    return np.isfinite(_guarded(T, score).log_score).tolist()


def test_plausible_candidates_pass_unchanged():
    T = _poses([4.0, 5.0, 6.0])
    for drop in (True, False):
        candidates = _guarded(T, [0.3, 0.2, 0.1], drop)
        np.testing.assert_array_equal(candidates.log_score, [0.3, 0.2, 0.1])
        np.testing.assert_allclose(candidates.T_cam_target, T, atol=1e-14)


@pytest.mark.parametrize("score", [0.0, -0.1, np.nan, np.inf, -np.inf])
def test_a_score_that_is_not_positive_and_finite_drops_its_candidate(score):
    assert _kept(_poses([4, 5]), [score, 0.2]) == [False, True]


@pytest.mark.parametrize("depth", [0.0, -3.0, 120.0])
def test_depth_and_range_are_bounded(depth):
    assert _kept(_poses([5, depth]), [0.3, 0.2]) == [True, False]


def test_a_target_at_the_lens_is_dropped():
    T = _poses([5, 5])
    T[1, :3, 3] = [0, 0, 5e-4]
    assert _kept(T, [0.3, 0.2]) == [True, False]


def test_depths_far_from_the_median_are_dropped_only_among_three_or_more():
    assert _kept(_poses([5, 5.5, 16.0, 1.8]), [0.4, 0.3, 0.2, 0.1]) == [True, True, False, True]
    assert _kept(_poses([5, 5.5, 1.5]), [0.4, 0.3, 0.2]) == [True, True, False]
    assert _kept(_poses([5, 50]), [0.4, 0.3]) == [True, True]
    # The median is that of survivors: the third candidate's score removes it first.
    assert _kept(_poses([5, 50, 50]), [0.4, 0.3, 0.0]) == [True, True, False]


def test_a_dropped_candidate_keeps_its_slot_and_no_nan_travels_on():
    T = _poses([4, 5, 6])
    T[1] = np.nan
    candidates = _guarded(T, [0.1, 0.3, 0.2])
    assert np.isneginf(candidates.log_score[1])
    assert np.isfinite(candidates.pose_rows).all()
    np.testing.assert_allclose(candidates.T_cam_target[2], T[2], atol=1e-14)


def test_everything_may_be_dropped():
    assert _kept(_poses([-1, -2]), [0.3, 0.2]) == [False, False]


@pytest.mark.parametrize("score", [np.nan, np.inf, -np.inf])
def test_the_strict_policy_names_a_score_that_is_not_finite(score):
    with pytest.raises(CandidateError, match="candidate 1: its score"):
        _guarded(_poses([4, 5]), [0.1, score], drop=False)


def test_the_strict_policy_names_a_pose_that_is_not_rigid():
    T = _poses([4, 5, 6])
    T[2, :3, :3] *= 1.1
    with pytest.raises(CandidateError, match="candidate 2: its pose is not a finite rigid transform"):
        _guarded(T, [0.1, 0.2, 0.3], drop=False)


def test_the_strict_policy_drops_nothing_else():
    assert np.isfinite(_guarded(_poses([-4, 500]), [-1.0, -2.0], drop=False).log_score).all()
