"""The decoder against enumeration of every path, and its invariances."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from hat_ros.config import load_config
from hat_ros.core.selector import RunningGate, SelectorStage, motion_penalty, rotation_increment, scaled_score
from hat_ros.geometry import lie
from hat_ros.types import Candidates, Motion

# The published decoder, without its warm-up.
FREE = replace(load_config("mega_hat").selector, warmup_keyframes=1)


def _motion(R, epoch=0):
    return Motion(True, epoch, lie.row_from_matrix(lie.transform(R, np.zeros(3))))


def _keyframes(seed, n=5, k=3, dropped=0.0, missing=0.0):
    """Random candidates and SLAM rotations; some candidates dropped, some SLAM poses missing."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(n):
        score = rng.normal(size=k)
        score[rng.random(k) < dropped] = -np.inf
        T = lie.transform(lie.so3_exp(rng.normal(size=(k, 3))), rng.normal(size=(k, 3)))
        motion = Motion.none() if rng.random() < missing else _motion(lie.so3_exp(rng.normal(size=3)))
        out.append((Candidates(lie.row_from_matrix(T), score), motion))
    return out


def _run(keyframes, config=FREE):
    stage = SelectorStage(config)
    return [stage.update(candidates, motion) for candidates, motion in keyframes]


def _best_endpoint_by_enumeration(keyframes, config):
    """Eq. (viterbi) for every path: best total score of the paths that end in each candidate of the last keyframe."""
    best = np.full(len(keyframes[-1][0]), -np.inf)
    for path in product(*[range(len(candidates)) for candidates, _ in keyframes]):
        total = sum(
            config.score_scale * (candidates.log_score[i] - candidates.log_score.max())
            for (candidates, _), i in zip(keyframes, path, strict=True)
        )
        for (before, motion_before), (after, motion_after), i, j in zip(
            keyframes, keyframes[1:], path, path[1:], strict=False
        ):
            if motion_before.valid and motion_after.valid:
                increment = motion_after.T_slam_cam[:3, :3].T @ motion_before.T_slam_cam[:3, :3]
                predicted = increment @ before.T_cam_target[i, :3, :3]
                angle = np.degrees(lie.angle_between(after.T_cam_target[j, :3, :3], predicted))
                total -= min(config.motion_weight_per_deg * angle, config.max_motion_penalty or np.inf)
        best[path[-1]] = max(best[path[-1]], total)
    return best


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("dropped", "missing"), [(0.0, 0.0), (0.25, 0.3)])
def test_the_recurrence_finds_what_enumerating_all_paths_finds(seed, dropped, missing):
    keyframes = _keyframes(seed, dropped=dropped, missing=missing)
    keyframes = [(c, m) for c, m in keyframes if np.isfinite(c.log_score).any()]
    for length in range(1, len(keyframes) + 1):
        expected = _best_endpoint_by_enumeration(keyframes[:length], FREE)
        selection = _run(keyframes[:length])[-1]
        assert selection.selected == np.argmax(expected)
        alive = np.isfinite(expected)
        np.testing.assert_allclose(selection.path_score[alive], (expected - expected.max())[alive], atol=1e-9)
        assert np.isneginf(selection.path_score[~alive]).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_limited_penalty_is_still_the_best_of_all_paths(seed):
    config = replace(FREE, max_motion_penalty=8.0)
    keyframes = _keyframes(seed)
    expected = _best_endpoint_by_enumeration(keyframes, config)
    selection = _run(keyframes, config)[-1]
    np.testing.assert_allclose(selection.path_score, expected - expected.max(), atol=1e-9)


def test_an_orientation_missing_at_first_wins_once_evidence_exceeds_the_limit():
    """Its history can only begin at a wrong candidate, half a turn away."""
    wrong, right = np.eye(3), lie.so3_exp(np.array([np.pi, 0.0, 0.0]))
    row = lie.row_from_matrix(lie.transform(np.stack([wrong, right]), np.zeros((2, 3))))
    still = _motion(np.eye(3))
    keyframes = [(Candidates(row[:1], np.zeros(1)), still)] * 3
    keyframes += [(Candidates(row, np.array([0.0, 1.5])), still)] * 8
    limited = _run(keyframes, replace(FREE, score_scale=1.0, max_motion_penalty=8.0))
    published = _run(keyframes, replace(FREE, score_scale=1.0))
    assert [s.selected for s in limited[3:]] == [0] * 5 + [1] * 3
    assert all(s.selected == 0 for s in published)


def _half_a_turn_apart(turned_deg=0.0):
    """Two candidates, half a turn apart, both turned by an angle since the start."""
    R = lie.so3_exp(np.radians(turned_deg) * np.array([0.0, 0.0, 1.0]))
    return lie.row_from_matrix(lie.transform(np.stack([R, R @ lie.so3_exp(np.array([np.pi, 0, 0]))]), np.zeros((2, 3))))


def test_where_motion_is_missing_no_history_is_forgotten():
    still, none = Candidates(_half_a_turn_apart(), np.array([5.0, 0.0])), Motion.none()
    later = Candidates(_half_a_turn_apart(), np.array([0.0, 3.0]))
    limit = {"score_scale": 1.0, "max_motion_penalty": 8.0}
    assert [s.selected for s in _run([(still, none), (later, none)], replace(FREE, **limit))] == [0, 1]
    kept = _run([(still, none), (later, none)], replace(FREE, **limit, max_turn_deg_per_frame=5.0))
    assert [s.selected for s in kept] == [0, 0]
    assert kept[1].path_score[1] == pytest.approx(-2.0)  # 5 less 3, as if the motion were known to be none


@pytest.mark.parametrize(("n_frames", "penalty"), [(1, 0.3 * 25.0), (3, 0.3 * 15.0), (6, 0.0)])
def test_a_turn_that_the_time_allows_costs_nothing_where_motion_is_missing(n_frames, penalty):
    config = replace(FREE, max_motion_penalty=8.0, max_turn_deg_per_frame=5.0)
    before, after = (Candidates(_half_a_turn_apart(turned)[:1], np.zeros(1)) for turned in (0.0, 30.0))
    one, none = np.array([0]), Motion.none()
    found = motion_penalty(before, one, none, after, one, none, n_frames, config)
    np.testing.assert_allclose(found, [[penalty]], atol=1e-9)


def test_frames_without_candidates_count_as_time_gone_by():
    config = replace(FREE, score_scale=1.0, max_motion_penalty=8.0, max_turn_deg_per_frame=5.0)
    before = Candidates(_half_a_turn_apart(), np.array([6.0, 0.0]))
    after = Candidates(_half_a_turn_apart(90.0), np.array([0.0, 1.0]))
    lead = []
    for n_frames in (1, 20):
        none = [(Candidates.none(), Motion.none())] * (n_frames - 1)
        path = _run([(before, Motion.none()), *none, (after, Motion.none())], config)[-1].path_score
        lead.append(path[0] - path[1])
    assert lead == pytest.approx([-1.0, 5.0])  # at once a quarter turn is as unlikely as any; in time it is none


@pytest.mark.parametrize("seed", range(4))
def test_a_score_offset_per_keyframe_changes_nothing(seed):
    keyframes = _keyframes(seed, n=8)
    shifted = [(Candidates(c.pose_rows, c.log_score + 7.0 * i), m) for i, (c, m) in enumerate(keyframes)]
    assert [s.selected for s in _run(keyframes)] == [s.selected for s in _run(shifted)]


@pytest.mark.parametrize("seed", range(4))
def test_the_slam_gauge_changes_nothing(seed):
    keyframes, gauge = _keyframes(seed, n=8), lie.so3_exp(np.array([0.3, -2.0, 1.0]))
    turned = [(c, _motion(gauge @ m.T_slam_cam[:3, :3])) for c, m in keyframes]
    for a, b in zip(_run(keyframes), _run(turned), strict=True):
        assert a.selected == b.selected
        np.testing.assert_allclose(a.path_score, b.path_score, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_permuted_candidates_give_the_permuted_answer(seed):
    keyframes, rng = _keyframes(seed, n=8, k=5, dropped=0.2), np.random.default_rng(seed)
    orders = [rng.permutation(5) for _ in keyframes]
    permuted = [
        (Candidates(c.pose_rows[order], c.log_score[order]), m) for (c, m), order in zip(keyframes, orders, strict=True)
    ]
    for a, b, order in zip(_run(keyframes), _run(permuted), orders, strict=True):
        assert (a.selected == -1) == (b.selected == -1)
        if a.selected >= 0:
            assert order[b.selected] == a.selected
            np.testing.assert_allclose(b.path_score, a.path_score[order], atol=1e-9)


def test_opposite_quaternions_are_the_same_candidates():
    keyframes = _keyframes(0, n=8)
    sign = np.array([1, 1, 1, -1, -1, -1, -1])
    flipped = [(Candidates(c.pose_rows * sign, c.log_score), m) for c, m in keyframes]
    assert [s.selected for s in _run(keyframes)] == [s.selected for s in _run(flipped)]


def test_motion_overrules_appearance_and_keeps_the_competing_basin_alive():
    """A half-turned candidate wins one keyframe on appearance; later evidence may still bring it back."""
    half_turn = lie.so3_exp(np.array([0, np.pi, 0]))
    T = lie.transform(np.stack([np.eye(3), half_turn]), np.array([[0.0, 0, 5]] * 2))
    still = _motion(np.eye(3))

    def keyframe(truth, other):
        return Candidates(lie.row_from_matrix(T), np.array([truth, other])), still

    first = [keyframe(1.0, 0.0)] * 3 + [keyframe(0.0, 2.0)]
    assert [s.selected for s in _run(first)] == [0, 0, 0, 0]
    assert _run(first + [keyframe(0.0, 30.0)])[-1].selected == 1


def test_before_the_warm_up_is_over_the_best_appearance_is_the_anchor():
    keyframes = _keyframes(3, n=12)
    stage = SelectorStage(replace(FREE, warmup_keyframes=3))
    for i, (candidates, motion) in enumerate(keyframes):
        selection = stage.update(candidates, motion)
        assert stage.accepted == (i >= 2)
        expected = np.argmax(selection.path_score) if i >= 2 else np.argmax(candidates.log_score)
        assert selection.selected == expected


@pytest.mark.parametrize("gap", ["missing now", "missing before", "new epoch"])
def test_no_increment_no_penalty(gap):
    (a, motion_a), (b, motion_b) = _keyframes(5, n=2)
    if gap == "missing before":
        motion_a = Motion.none()
    elif gap == "missing now":
        motion_b = Motion.none()
    else:
        motion_b = Motion(True, 1, motion_b.pose_row)
    assert rotation_increment(motion_a, motion_b) is None
    selection = _run([(a, motion_a), (b, motion_b)])[-1]
    np.testing.assert_allclose(selection.path_score, selection.scaled_score, atol=1e-12)


def test_a_keyframe_without_survivors_does_not_advance_the_decoder():
    keyframes = _keyframes(7, n=6)
    nothing = Candidates(keyframes[0][0].pose_rows, np.full(3, -np.inf))
    stage, plain = SelectorStage(FREE), SelectorStage(FREE)
    for candidates, motion in keyframes:
        gap = stage.update(nothing, _motion(lie.so3_exp(np.array([1.0, 2.0, 3.0]))))
        assert (gap.selected, stage.accepted) == (-1, False)
        assert gap.anchor is None
        assert stage.update(Candidates.none(), motion).selected == -1
        a, b = stage.update(candidates, motion), plain.update(candidates, motion)
        assert a.selected == b.selected
        np.testing.assert_array_equal(a.path_score, b.path_score)


def test_path_scores_stay_bounded_over_any_length():
    stage = SelectorStage(FREE)
    keyframes = _keyframes(1, n=50)
    for _ in range(20):
        for candidates, motion in keyframes:
            path = stage.update(candidates, motion).path_score
            assert path.max() == 0.0
            assert path.min() > -0.3 * 360 - 100


@pytest.mark.parametrize(
    ("size_px", "weight"), [(500, 1.0), (250, 0.25), (1000, 1.0), (50, 0.05), (1, 0.05), (400, 0.64)]
)
def test_size_weight_is_the_papers(size_px, weight):
    config = replace(FREE, score_scale=2.0, size_weighting=True)
    candidates = Candidates(np.zeros((2, 7)), np.array([0.5, -0.5]), np.array([10.0, 20, 10 + size_px, 20 + size_px]))
    np.testing.assert_allclose(scaled_score(candidates, config), [0.0, -2.0 * weight], atol=1e-12)
    unknown = Candidates(np.zeros((2, 7)), np.array([0.5, -0.5]))
    np.testing.assert_allclose(scaled_score(unknown, config), [0.0, -2.0])


class TestRunningGate:
    CONFIG = replace(FREE, running_gate=True)

    @staticmethod
    def _keyframe(turns_deg, scores):
        R = lie.so3_exp(np.radians([[0.0, angle, 0.0] for angle in turns_deg]))
        return Candidates(lie.row_from_matrix(lie.transform(R, np.array([[0.0, 0, 5]] * len(R)))), np.array(scores))

    def test_the_decoder_is_trusted_while_candidates_support_each_other(self):
        stage, still = SelectorStage(self.CONFIG), _motion(np.eye(3))
        for _ in range(3):
            stage.update(self._keyframe([0, 10, 180], [1.0, 0.9, 0.0]), still)
            assert stage.accepted
        # Three keyframes with support 2 and one with 1: the median is still 2.
        selection = stage.update(self._keyframe([180, 0, 40], [1.0, 0.5, 0.5]), still)
        assert (selection.selected, stage.accepted) == (1, True)

    def test_too_little_support_falls_back_to_appearance_and_leaves_the_scores_alone(self):
        stage, ungated, still = SelectorStage(self.CONFIG), SelectorStage(FREE), _motion(np.eye(3))
        lonely = [
            self._keyframe([0, 60, 180], [3.0, 0.0, 0.0]),
            self._keyframe([0, 60, 180], [0.0, 0.0, 0.5]),
        ]
        for keyframe, expected in zip(lonely, (0, 2), strict=True):
            gated, free = stage.update(keyframe, still), ungated.update(keyframe, still)
            assert (gated.selected, free.selected) == (expected, 0)
            assert not stage.accepted
            np.testing.assert_array_equal(gated.path_score, free.path_score)

    def test_a_decoder_that_always_overrides_is_not_trusted(self):
        stage, still = SelectorStage(self.CONFIG), _motion(np.eye(3))
        stage.update(self._keyframe([0, 5, 180], [50.0, 0.0, 0.0]), still)
        accepted = []
        for _ in range(6):
            stage.update(self._keyframe([180, 185, 0], [1.0, 0.9, 0.0]), still)
            accepted.append(stage.accepted)
        # Overrides so far 1/2, 2/3, 3/4 ...: the third reaches beyond 0.7.
        assert accepted == [True, True, False, False, False, False]

    def test_the_median_is_exact_and_its_memory_bounded(self):
        rng, gate, seen = np.random.default_rng(0), RunningGate(self.CONFIG), []
        for _ in range(300):
            support = int(rng.integers(1, 6))
            candidates = self._keyframe([0] * support + [90] * (6 - support), [1.0] * 6)
            gate.observe(candidates, np.arange(6), 0, 0)
            seen.append(support)
            assert gate.median_support == np.median(seen)
        assert len(gate._support_histogram) <= 7


def test_reset_forgets_everything():
    keyframes = _keyframes(9, n=6)
    stage = SelectorStage(replace(FREE, running_gate=True))
    for candidates, motion in keyframes:
        stage.update(candidates, motion)
    stage.reset()
    fresh = _run(keyframes, replace(FREE, running_gate=True))
    for expected, (candidates, motion) in zip(fresh, keyframes, strict=True):
        selection = stage.update(candidates, motion)
        assert selection.selected == expected.selected
        np.testing.assert_array_equal(selection.path_score, expected.path_score)
