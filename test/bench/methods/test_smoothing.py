"""The offline reference: the best path of all, the joint optimum of all, and better than causal."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import scipy.optimize
from temporal_scene import HALF_TURN, make_scene, preset, rotation_error_deg

from hat_ros.bench.methods.pose_graph import PoseGraph
from hat_ros.bench.methods.smoothing import backtrace, consistent, smooth_anchors, smooth_measured
from hat_ros.bench.methods.temporal import run_temporal
from hat_ros.config import FusionConfig, load_config
from hat_ros.core.selector import motion_penalty, scaled_score
from hat_ros.geometry import lie
from hat_ros.types import Candidates, Motion

PUBLISHED = load_config("mega_hat").selector


def _recorded(scene, drop=False):
    o = scene.observations
    return [o.candidates(i, drop) for i in range(len(o))], [o.motion(i) for i in range(len(o))]


@pytest.mark.parametrize("seed", range(4))
def test_the_path_is_the_best_of_all_paths(seed):
    config = PUBLISHED
    scene = make_scene(20, k=3, seed=seed, noise_deg=20, rate_deg=6)
    candidates, motions = _recorded(scene)
    keys = [i for i, group in enumerate(candidates) if len(group)]
    every = np.arange(3)

    def total(path):
        score = sum(scaled_score(candidates[i], config)[k] for i, k in zip(keys, path, strict=True))
        for (i, a), (j, b) in zip(zip(keys, path, strict=True), list(zip(keys, path, strict=True))[1:], strict=False):
            score -= motion_penalty(candidates[i], every, motions[i], candidates[j], every, motions[j], j - i, config)[
                b, a
            ]
        return score

    best = max(product(range(3), repeat=len(keys)), key=total)
    assert backtrace(candidates, motions, config)[keys].tolist() == list(best)


def test_the_gate_is_one_decision_over_the_whole_sequence():
    scene = make_scene(60, k=3, competing_score=0.3)
    candidates, motions = _recorded(scene)
    keys = np.flatnonzero(scene.observations.key)
    # No candidate supports another: the median count is one, so every keyframe takes its best appearance.
    chosen = backtrace(candidates, motions, replace(PUBLISHED, running_gate=True, gate_neighbourhood_deg=0.001))
    np.testing.assert_array_equal(chosen[keys], np.argmax(scene.observations.scores[keys], axis=1))


def test_keyframes_without_survivors_are_passed_over():
    scene = make_scene(40, k=3)
    candidates, motions = _recorded(scene)
    candidates[12] = Candidates(candidates[12].pose_rows, np.full(3, -np.inf))
    chosen = backtrace(candidates, motions, PUBLISHED)
    assert chosen[12] == -1
    assert (chosen[[0, 4, 8, 16, 20]] >= 0).all()
    assert (backtrace([Candidates.none()] * 5, [Motion.none()] * 5, PUBLISHED) == -1).all()


@pytest.mark.parametrize("name", ["mega_hat", "pico_hat", "mega_hat_spark"])
def test_smoothing_is_no_worse_than_causal(name):
    config, causal_deg, offline_deg = preset(name), [], []
    for seed in range(3):
        scene = make_scene(160, seed=seed, noise_deg=4)
        result = run_temporal(scene.observations, config)
        offline = smooth_anchors(*_recorded(scene, config.hypotheses.guard), config)
        causal_deg.append(rotation_error_deg(result.T_cam_target, scene.T_cam_target).mean())
        offline_deg.append(rotation_error_deg(offline.T_cam_target, scene.T_cam_target).mean())
        assert lie.is_rigid(offline.T_cam_target, 1e-9).all()
    assert np.mean(offline_deg) <= np.mean(causal_deg)


def test_frames_without_slam_or_anchor_hold_their_neighbour():
    scene = make_scene(60)
    candidates, motions = _recorded(scene)
    for i in (1, 2, 3, 30, 31):
        motions[i] = Motion.none()
    T = smooth_anchors(candidates, motions, preset()).T_cam_target
    np.testing.assert_array_equal(T[1:4], T[[0, 0, 0]])
    np.testing.assert_array_equal(T[30:32], T[[29, 29]])
    tied = smooth_anchors(candidates, motions, preset()).tied
    assert np.flatnonzero(~tied).tolist() == [1, 2, 3, 30, 31], "held, or an anchor that nothing can be compared with"
    empty = smooth_anchors([Candidates.none()] * 3, motions[:3], preset())
    assert np.isnan(empty.T_cam_target).all()


def _tumbling_motion(scene, scale_drift=0.0, drift_deg=0.0):
    """The scene's motion with a scale and a rotation that drift by this much per frame."""
    out = []
    for i, T in enumerate(scene.observations.slam):
        drifted = T.copy()
        drifted[:3, :3] = lie.so3_exp(np.radians([drift_deg * i, 0, 0])) @ T[:3, :3]
        drifted[:3, 3] *= 1 + scale_drift * i
        out.append(Motion(True, 0, lie.row_from_matrix(drifted)))
    return out


@pytest.mark.parametrize("weight", [0.002, 0.1])
def test_poses_do_not_bow_between_anchors_when_the_scale_drifts(weight):
    """Anchors are true; the target tumbles by 4 degrees per frame 8 m away, the scale is wrong nearly everywhere."""
    scene = make_scene(120, gap=6, noise_deg=0, noise_m=0, rate_deg=4, gauge=np.eye(4))
    candidates, _ = _recorded(scene)
    config = preset("pico_hat", fusion={"relative_weight": weight}, selector={"running_gate": False})
    result = smooth_anchors(candidates, _tumbling_motion(scene, scale_drift=0.001), config)
    keys = np.flatnonzero(scene.observations.key)
    between = slice(keys[0], keys[-1])
    shift_m = np.linalg.norm(result.T_cam_target[:, :3, 3] - scene.T_cam_target[:, :3, 3], axis=1)
    assert rotation_error_deg(result.T_cam_target, scene.T_cam_target)[between].max() < 0.1
    assert shift_m[between].max() < 0.1


class TestConsistent:
    CONFIG = preset("pico_hat")

    @staticmethod
    def _anchors(n=30, wrong=(), **drift):
        scene = make_scene(n, gap=1, rate_deg=2, gauge=lie.transform(lie.so3_exp(np.array([1.0, 2, 3])), np.ones(3)))
        anchors = list(scene.T_cam_target)
        for i in wrong:
            anchors[i] = lie.transform(anchors[i][:3, :3] @ HALF_TURN, anchors[i][:3, 3])
        return anchors, _tumbling_motion(scene, **drift)

    @pytest.mark.parametrize("wrong", [(7,), (0,), (29,), (3, 11, 12, 20), (10, 11, 12, 13, 14), (27, 28, 29)])
    def test_leaves_out_what_does_not_fit_the_others(self, wrong):
        kept = consistent(*self._anchors(wrong=wrong), self.CONFIG)
        assert np.flatnonzero(~kept).tolist() == list(wrong)

    def test_a_change_of_basin_that_enough_anchors_stand_for_is_followed(self):
        kept = consistent(*self._anchors(wrong=range(18, 30)), self.CONFIG)
        assert kept.all()

    def test_motion_that_drifts_by_any_angle_leaves_out_nothing(self):
        kept = consistent(*self._anchors(wrong=(9,), drift_deg=6.0), self.CONFIG)
        assert np.flatnonzero(~kept).tolist() == [9]

    def test_motion_that_fits_nothing_proves_nothing(self):
        kept = consistent(*self._anchors(drift_deg=70.0), self.CONFIG)
        assert kept.all()

    def test_few_or_no_anchors(self):
        assert consistent([], [], self.CONFIG).shape == (0,)
        anchors, motions = self._anchors(n=1)
        assert consistent(anchors, motions, self.CONFIG).tolist() == [True]

    def test_what_was_left_out_is_said(self):
        scene = make_scene(60, k=2, gap=4, noise_deg=1, competing_score=0.1)
        candidates, motions = _recorded(scene)
        T = candidates[20].T_cam_target[0]
        flipped = lie.transform(scene.T_cam_target[20, :3, :3] @ HALF_TURN, T[:3, 3])
        candidates[20] = Candidates.from_matrices(flipped[None], np.ones(1))
        result = smooth_anchors(candidates, motions, preset(selector={"motion_weight_per_deg": 0.0}))
        assert np.flatnonzero(result.gate_weight == 0.0).tolist() == [20]
        assert np.isnan(result.gate_weight[1])
        assert rotation_error_deg(result.T_cam_target[20], scene.T_cam_target[20]) < 5


class TestPoseGraph:
    @staticmethod
    def _graph(config, seed=0, n=6):
        rng = np.random.default_rng(seed)
        graph, terms = PoseGraph(n, config, 1.0), {"anchors": [], "steps": []}
        poses = lie.transform(lie.so3_exp(0.3 * rng.normal(size=(n, 3))), rng.normal(size=(n, 3)) + [0, 0, 6])
        for i in range(n):
            graph.add_pose(i, poses[i])
            if i % 2 == 0:
                anchor = lie.transform(lie.so3_exp(0.1 * rng.normal(size=3)) @ poses[i, :3, :3], poses[i, :3, 3] + 0.1)
                graph.add_anchor(i, anchor, 0.8)
                terms["anchors"].append((i, anchor, 0.8))
            if i:
                step = poses[i] @ lie.inverse(poses[i - 1])
                step[:3, :3] = lie.so3_exp(0.05 * rng.normal(size=3)) @ step[:3, :3]
                graph.add_step(i, step)
                terms["steps"].append((i, step))
        return graph, terms, poses

    @pytest.mark.parametrize("loss", ["huber", "linear"])
    @pytest.mark.parametrize("seed", range(3))
    def test_it_finds_the_joint_optimum_that_scipy_finds(self, loss, seed):
        config = FusionConfig(relative_weight=0.5, loss=loss, huber_delta_m=0.05)
        graph, terms, poses = self._graph(config, seed)
        ours = graph.solve()

        def residuals(x, base):
            X = x.reshape(-1, 6)
            T = lie.transform(lie.so3_exp(X[:, :3]) @ base[:, :3, :3], base[:, :3, 3] + X[:, 3:])
            out = []
            for i, M, g in terms["anchors"]:
                out += [g * lie.so3_log(M[:3, :3] @ T[i, :3, :3].T), g * (M[:3, 3] - T[i, :3, 3])]
            for i, step in terms["steps"]:
                predicted = step @ T[i - 1]
                out += [0.5 * lie.so3_log(predicted[:3, :3] @ T[i, :3, :3].T), 0.5 * (predicted - T[i])[:3, 3]]
            return np.concatenate(out)

        kind = {} if loss == "linear" else {"loss": "huber", "f_scale": 0.05}
        found = scipy.optimize.least_squares(residuals, np.zeros(36), args=(ours,), xtol=1e-15, ftol=1e-15, **kind)
        np.testing.assert_allclose(found.x, 0.0, atol=2e-4)
        start = scipy.optimize.least_squares(residuals, np.zeros(36), args=(poses,), xtol=1e-15, ftol=1e-15, **kind)
        here = scipy.optimize.least_squares(residuals, np.zeros(36), args=(ours,), max_nfev=1, **kind)
        assert here.cost <= start.cost * (1 + 1e-6)

    def test_poses_without_any_term_stay_where_they_start(self):
        graph = PoseGraph(3, FusionConfig(), 1.0)
        T = lie.transform(np.eye(3), np.array([0.0, 0, 5]))
        graph.add_pose(1, T)
        out = graph.solve()
        np.testing.assert_allclose(out[1], T, atol=1e-9)
        assert np.isnan(out[[0, 2]]).all()


class TestSmoothMeasured:
    CONFIG = preset("pico_hat")

    @staticmethod
    def _noisy(scene, sigma_deg=0.5, sigma_m=0.02, seed=0):
        rng = np.random.default_rng(seed)
        T = scene.T_cam_target.copy()
        T[:, :3, :3] = lie.so3_exp(np.radians(sigma_deg) * rng.normal(size=(len(T), 3))) @ T[:, :3, :3]
        T[:, :3, 3] += sigma_m * rng.normal(size=(len(T), 3))
        return T

    def test_motion_quietens_what_jitters(self):
        scene = make_scene(120, rate_deg=3)
        measured = self._noisy(scene)
        smooth = smooth_measured(measured, _recorded(scene)[1], self.CONFIG)
        before = rotation_error_deg(measured, scene.T_cam_target).mean()
        assert rotation_error_deg(smooth, scene.T_cam_target).mean() < 0.8 * before
        shift_m = np.linalg.norm(smooth[:, :3, 3] - scene.T_cam_target[:, :3, 3], axis=1)
        assert shift_m.mean() < 0.8 * np.linalg.norm(measured[:, :3, 3] - scene.T_cam_target[:, :3, 3], axis=1).mean()

    def test_motion_that_drifts_pulls_no_measurement_away(self):
        scene = make_scene(120, rate_deg=3, gauge=np.eye(4))
        motions = _tumbling_motion(scene, drift_deg=0.3)
        smooth = smooth_measured(scene.T_cam_target, motions, self.CONFIG)
        assert rotation_error_deg(smooth, scene.T_cam_target).max() < 0.3

    def test_a_step_that_is_far_off_moves_nothing(self):
        scene = make_scene(60, rate_deg=3, gauge=np.eye(4))
        motions = _recorded(scene)[1]
        for i in range(30, 60):
            jump = lie.transform(lie.so3_exp(np.radians([0.0, 4.0, 0.0])), np.array([0.3, 0.0, 0.0]))
            motions[i] = Motion(True, 0, lie.row_from_matrix(jump @ motions[i].T_slam_cam))
        measured = self._noisy(scene, sigma_deg=0.2, sigma_m=0.01)
        smooth = smooth_measured(measured, motions, self.CONFIG)
        assert rotation_error_deg(smooth, scene.T_cam_target)[25:35].max() < 0.8
        shift_m = np.linalg.norm(smooth[:, :3, 3] - scene.T_cam_target[:, :3, 3], axis=1)
        assert shift_m[25:35].max() < 0.08

    def test_motion_bridges_frames_that_were_not_measured(self):
        scene = make_scene(90, rate_deg=3)
        measured = scene.T_cam_target.copy()
        measured[40:50] = np.nan
        smooth = smooth_measured(measured, _recorded(scene)[1], self.CONFIG)
        assert rotation_error_deg(smooth, scene.T_cam_target).max() < 0.5

    def test_what_nothing_reaches_stays_unknown(self):
        scene = make_scene(30)
        motions = [Motion.none()] * 30
        measured = np.full((30, 4, 4), np.nan)
        assert np.isnan(smooth_measured(measured, motions, self.CONFIG)).all()
        measured[7] = scene.T_cam_target[7]
        smooth = smooth_measured(measured, motions, self.CONFIG)
        np.testing.assert_allclose(smooth[7], measured[7], atol=1e-9)
        assert np.isnan(np.delete(smooth, 7, axis=0)).all()
