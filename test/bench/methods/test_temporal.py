"""Stages 3 and 4 over recorded observations: the published schedule, invariances, causality, bad files."""

from dataclasses import replace

import numpy as np
import pytest
from observed_log import CONFIG, observations
from temporal_scene import HALF_TURN, make_scene, preset, rotation_error_deg

from hat_ros.bench.evaluation.metrics import pose_errors
from hat_ros.bench.methods.temporal import keyframes_of, replay_offline, replay_temporal, run_offline, run_temporal
from hat_ros.bench.observations import Observations, observations_of
from hat_ros.errors import CandidateError
from hat_ros.geometry import lie

PRESETS = ("mega_hat", "pico_hat", "mega_hat_spark")


@pytest.fixture(scope="module")
def scene():
    return make_scene()


def _changed(observations, **arrays):
    return replace(observations, **arrays)


def _perfect(n=60, **options):
    """No noise: the anchors that are right are exact, and so must every fused pose be."""
    scene = make_scene(n, noise_deg=0, noise_m=0, competing_score=0.1, **options)
    return scene.T_cam_target, scene.observations


@pytest.mark.parametrize("name", PRESETS)
def test_prefix_the_first_frames_give_the_first_outputs(name, scene):
    config, whole = preset(name), run_temporal(scene.observations, preset(name))
    for n in (1, 9, 41, 100):
        part = run_temporal(_cut(scene.observations, n), config)
        assert part.T_cam_target.tobytes() == whole.T_cam_target[:n].tobytes()
        assert part.chosen.tolist() == whole.chosen[:n].tolist()
        assert part.accepted.tolist() == whole.accepted[:n].tolist()
        assert part.resets.tolist() == [frame for frame in whole.resets if frame < n]


@pytest.mark.parametrize("name", PRESETS)
def test_corrupting_later_frames_changes_nothing_earlier(name, scene):
    config, o = preset(name), scene.observations
    poses, slam = o.poses.copy(), o.slam.copy()
    poses[60:] = poses[60:, ::-1]
    slam[60:] = np.nan
    a = run_temporal(o, config)
    b = run_temporal(_changed(o, poses=poses, slam=slam), config)
    assert a.T_cam_target[:60].tobytes() == b.T_cam_target[:60].tobytes()
    assert a.T_cam_target[60:].tobytes() != b.T_cam_target[60:].tobytes()


def _cut(o, n):
    return Observations(o.slam[:n], o.key[:n], o.poses[:n], o.scores[:n], o.box_area_px[:n])


@pytest.mark.parametrize("name", PRESETS)
def test_slam_gauge_and_scale_change_nothing(name, scene):
    o = scene.observations
    slam = lie.transform(lie.so3_exp(np.array([2.0, -0.5, 1.0])), np.array([5.0, 2, -3])) @ o.slam
    slam[:, :3, 3] *= 0.21
    a, b = run_temporal(o, preset(name)), run_temporal(_changed(o, slam=slam), preset(name))
    np.testing.assert_array_equal(a.chosen, b.chosen)
    np.testing.assert_allclose(a.T_cam_target, b.T_cam_target, atol=1e-7)


@pytest.mark.parametrize("name", ["mega_hat", "mega_hat_spark"])
def test_a_score_offset_changes_nothing(name, scene):
    o = scene.observations
    scores = o.scores + np.linspace(-4, 9, len(o))[:, None]
    a, b = run_temporal(o, preset(name)), run_temporal(_changed(o, scores=scores), preset(name))
    np.testing.assert_array_equal(a.chosen, b.chosen)
    np.testing.assert_allclose(a.T_cam_target, b.T_cam_target, atol=1e-9)


@pytest.mark.parametrize("name", PRESETS)
def test_permuted_candidates_give_permuted_choices_and_the_same_poses(name, scene):
    o, rng = scene.observations, np.random.default_rng(0)
    orders = np.stack([rng.permutation(o.poses.shape[1]) for _ in range(len(o))])
    rows = np.arange(len(o))[:, None]
    a = run_temporal(o, preset(name))
    b = run_temporal(_changed(o, poses=o.poses[rows, orders], scores=o.scores[rows, orders]), preset(name))
    np.testing.assert_array_equal(a.T_cam_target, b.T_cam_target)
    keys = np.flatnonzero(a.chosen >= 0)
    np.testing.assert_array_equal(orders[keys, b.chosen[keys]], a.chosen[keys])


@pytest.mark.parametrize("name", ["mega_hat", "pico_hat"])
def test_offline_poses_do_not_depend_on_the_gauge_and_are_closer_to_the_truth(name):
    scene = make_scene(100, noise_deg=3)
    config = preset(name, selector={"running_gate": False})
    offline = run_offline(scene.observations, config)
    gauge = lie.transform(lie.so3_exp(np.array([0.4, -2.0, 1.0])), np.array([3.0, 1.0, -2.0]))
    moved = run_offline(replace(scene.observations, slam=gauge @ scene.observations.slam), config)
    np.testing.assert_allclose(moved.T_cam_target, offline.T_cam_target, atol=1e-6)
    np.testing.assert_array_equal(moved.chosen, offline.chosen)
    assert set(np.flatnonzero(offline.accepted)) <= set(np.flatnonzero(scene.observations.key))
    causal = run_temporal(scene.observations, config)
    errors = [rotation_error_deg(r.T_cam_target, scene.T_cam_target).mean() for r in (offline, causal)]
    assert errors[0] <= errors[1]


def test_hat_follows_the_truth_where_appearance_flips():
    scene = make_scene(240, seed=3)
    result = run_temporal(scene.observations, preset())
    error = rotation_error_deg(result.T_cam_target, scene.T_cam_target)
    keys = np.flatnonzero(scene.observations.key)
    best = np.nanargmax(scene.observations.scores[keys], axis=1)
    independent = rotation_error_deg(scene.observations.poses[keys, best], scene.T_cam_target[keys])
    assert np.mean(independent > 90) > 0.1
    assert (error[60:] < 15).all()


class TestSchedule:
    def test_without_noise_every_frame_after_the_warm_up_is_exact(self):
        T, observations = _perfect()
        result = run_temporal(observations, preset())
        np.testing.assert_allclose(result.T_cam_target[12:], T[12:], atol=1e-9)
        assert not result.held[12:].any()

    def test_before_fusion_an_anchor_frame_outputs_its_anchor_and_others_hold_it(self):
        scene = make_scene(30)
        result = run_temporal(scene.observations, preset())
        for frame in range(12):
            key = frame - frame % 4
            anchor = scene.observations.poses[key, result.chosen[key]]
            np.testing.assert_allclose(result.T_cam_target[frame], anchor, atol=1e-12)
            assert result.held[frame] == (frame % 4 != 0)
        assert not result.held[12:].any()

    def test_chosen_is_minus_one_between_keyframes_and_accepted_from_the_third_on(self):
        result = run_temporal(make_scene(40).observations, preset())
        keys = np.arange(40) % 4 == 0
        assert (result.chosen[~keys] == -1).all()
        assert (result.chosen[keys] >= 0).all()
        assert np.flatnonzero(result.accepted).tolist() == list(range(8, 40, 4))

    def test_before_the_first_anchor_there_is_no_pose(self):
        scene = make_scene(40)
        key = scene.observations.key.copy()
        key[:8] = False
        result = run_temporal(_changed(scene.observations, key=key), preset())
        assert np.isnan(result.T_cam_target[:8]).all()
        assert np.isfinite(result.T_cam_target[8:]).all()
        assert not result.held[:8].any()

    def test_a_pose_is_held_without_limit(self):
        scene = make_scene(200)
        o = scene.observations
        key, slam = o.key.copy(), o.slam.copy()
        key[40:], slam[40:] = False, np.nan
        result = run_temporal(_changed(o, key=key, slam=slam), preset())
        np.testing.assert_allclose(result.T_cam_target[40:], result.T_cam_target[[39] * 160], atol=1e-14)
        assert result.held[40:].all()

    def test_where_slam_is_missing_an_anchor_stands_alone_and_the_rest_is_held(self):
        scene = make_scene(60)
        slam = scene.observations.slam.copy()
        slam[30:38] = np.nan
        result = run_temporal(_changed(scene.observations, slam=slam), preset())
        anchor = scene.observations.poses[32, result.chosen[32]]
        np.testing.assert_allclose(result.T_cam_target[32], anchor, atol=1e-12)
        assert np.flatnonzero(result.held[13:]).tolist() == [30 - 13, 31 - 13, 33 - 13, 34 - 13, 35 - 13, 37 - 13]

    def test_after_a_gap_the_aligned_slam_pose_takes_over(self):
        """Noise-free anchors until the gap: there the aligned SLAM pose is exact."""
        T, observations = _perfect(60)
        slam, key = observations.slam.copy(), observations.key.copy()
        slam[30:33], key[30:] = np.nan, False
        result = run_temporal(_changed(observations, slam=slam, key=key), preset())
        assert result.held[30:33].all()
        np.testing.assert_allclose(result.T_cam_target[33:], T[33:], atol=1e-9)

    def test_rotating_gap_fill_follows_slam_about_a_held_position(self):
        T, observations = _perfect(20)
        result = run_temporal(observations, preset("mega_hat", fusion={"gap_fill": "rotate"}))
        np.testing.assert_allclose(result.T_cam_target[:, :3, :3], T[:, :3, :3], atol=1e-9)
        np.testing.assert_allclose(result.T_cam_target[1:4, :3, 3], T[[0, 0, 0], :3, 3], atol=1e-12)


class TestReset:
    @staticmethod
    def _flipped_from(start):
        """From one frame on the front end only knows the half-turned basin."""
        T, o = _perfect(100, k=1)
        poses = o.poses.copy()
        poses[start:, :, :3, :3] = T[start:, None, :3, :3] @ HALF_TURN
        return T, _changed(o, poses=poses)

    def test_four_coherent_dissenting_anchors_drop_the_alignment(self):
        T, observations = self._flipped_from(40)
        result = run_temporal(observations, preset())
        assert result.resets.tolist() == [52]
        error = rotation_error_deg(result.T_cam_target, T)
        # Until the reset the weakened anchors barely pull; from the triggering frame onward the new basin rules.
        np.testing.assert_allclose(error[52::4], 180.0, atol=1e-3)
        assert (error[13:40] < 1e-6).all()

    def test_after_a_reset_the_warm_up_starts_over_and_the_triggering_anchor_does_not_count(self):
        _, observations = self._flipped_from(40)
        result = run_temporal(observations, preset())
        assert np.flatnonzero(result.held[50:]).tolist() == [3, 4, 5, 7, 8, 9, 11, 12, 13, 15, 16, 17]

    def test_three_are_not_enough_and_an_agreeing_one_clears_the_count(self):
        T, o = _perfect(100, k=1)
        poses = o.poses.copy()
        for key in (40, 44, 48, 56, 60, 64, 72):
            poses[key, :, :3, :3] = T[key, :3, :3] @ HALF_TURN
        assert run_temporal(_changed(o, poses=poses), preset()).resets.tolist() == []

    def test_incoherent_dissenters_never_add_up(self):
        T, o = _perfect(140, k=1)
        poses, turns = o.poses.copy(), lie.so3_exp(np.array([[0, np.pi, 0], [np.pi, 0, 0], [0, 0, np.pi]]))
        for i, key in enumerate(range(40, 140, 4)):
            poses[key, :, :3, :3] = T[key, :3, :3] @ turns[i % 3]
        assert run_temporal(_changed(o, poses=poses), preset()).resets.tolist() == []

    def test_dissenting_anchors_are_weakened_not_followed(self):
        T, o = _perfect(100, k=1)
        poses = o.poses.copy()
        poses[40, :, :3, :3] = T[40, :3, :3] @ HALF_TURN
        result = run_temporal(_changed(o, poses=poses), preset("pico_hat"))
        error = rotation_error_deg(result.T_cam_target, T)
        assert 10 < error[40] < 60
        assert error[48] < 1.0


class TestGuardInTheLoop:
    def test_pico_keeps_running_where_all_candidates_are_dropped(self):
        scene = make_scene(60)
        scores = scene.observations.scores.copy()
        scores[24] = -1.0
        result = run_temporal(_changed(scene.observations, scores=scores), preset("pico_hat"))
        assert result.chosen[24] == -1
        assert not result.accepted[24]
        assert np.isfinite(result.T_cam_target[24]).all()
        assert result.chosen[28] >= 0

    def test_pico_accepts_padding_with_nan(self):
        scene = make_scene(40)
        poses, scores = scene.observations.poses.copy(), scene.observations.scores.copy()
        poses[8, 3:], scores[8, 3:] = np.nan, np.nan
        result = run_temporal(_changed(scene.observations, poses=poses, scores=scores), preset("pico_hat"))
        assert 0 <= result.chosen[8] < 3

    @pytest.mark.parametrize("what", ["score", "pose"])
    def test_mega_names_frame_and_candidate(self, what):
        scene = make_scene(40)
        poses, scores = scene.observations.poses.copy(), scene.observations.scores.copy()
        if what == "score":
            scores[8, 2] = np.nan
        else:
            poses[8, 2, 0, 0] = 7.0
        with pytest.raises(CandidateError, match="frame 8, candidate 2"):
            run_temporal(_changed(scene.observations, poses=poses, scores=scores), preset())


def test_opposite_ends_of_the_half_turn_are_no_trouble():
    """A target at almost 180 degrees all along: no jump of the sign or of the angle."""
    gauge = lie.transform(HALF_TURN, np.zeros(3))
    scene = make_scene(60, noise_deg=0, noise_m=0, competing_score=0.1, gauge=gauge, rate_deg=0.01)
    result = run_temporal(scene.observations, preset())
    np.testing.assert_allclose(result.T_cam_target[12:], scene.T_cam_target[12:], atol=1e-9)


def test_keyframes_follow_gap_and_k():
    log = observations()
    groups = keyframes_of(log, replace(CONFIG, hypotheses=replace(CONFIG.hypotheses, max_candidates=1)))
    assert [len(group) for group in groups[:9]] == [1, 0, 0, 0, 1, 0, 0, 0, 1]


def test_replay_is_hat_temporal_on_the_same_observations():
    log = observations(flip_every=3)
    due = np.array([len(group) > 0 for group in keyframes_of(log, CONFIG)])
    recorded = replace(observations_of(log), key=due)
    expected = run_temporal(recorded, CONFIG)
    replayed = replay_temporal(log, CONFIG)
    np.testing.assert_allclose(replayed.T_est, expected.T_cam_target, atol=1e-9)
    np.testing.assert_array_equal(replayed.anchor, expected.chosen)


def test_a_pose_is_held_for_as_long_as_the_configuration_says():
    log = observations(motion=False)
    sparse = replace(CONFIG, keyframes=replace(CONFIG.keyframes, gap_frames=70))
    assert replay_temporal(log, sparse).has_output.all()
    limited = replace(sparse, fusion=replace(sparse.fusion, coast_limit_frames=60))
    assert np.flatnonzero(~replay_temporal(log, limited).has_output).tolist() == list(range(61, 70))


def test_offline_is_no_worse_than_causal_on_the_same_observations():
    log = observations(flip_every=2, noise_deg=2.0)
    causal, offline = replay_temporal(log, CONFIG), replay_offline(log, CONFIG)
    assert offline.has_output.all()
    errors = [pose_errors(answer.T_est, answer.T_true).pose.mean() for answer in (offline, causal)]
    assert errors[0] <= errors[1]
