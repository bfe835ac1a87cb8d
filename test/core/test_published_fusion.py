"""The published Stage 4, piece by piece."""

import numpy as np
import pytest
import scipy.optimize
from temporal_scene import HALF_TURN, make_scene, preset, rotation_error_deg

from hat_ros.config import FusionConfig
from hat_ros.core.published_fusion import AreaConfidence, Dissent, PublishedFusion, relative_motion
from hat_ros.geometry import lie
from hat_ros.types import Motion


def _motion(T_slam_cam, epoch=0):
    return Motion(True, epoch, lie.row_from_matrix(T_slam_cam))


def _pose(turn_deg, axis=(0, 1, 0)):
    return lie.transform(lie.so3_exp(np.radians(turn_deg) * np.array(axis, float)), np.array([0.0, 0, 6]))


def _fusion(name="mega_hat", **sections):
    return PublishedFusion(preset(name, **sections))


def _feed(fusion, scene, frames, anchors=None, epoch=0):
    """Run frames with perfect anchors at the keyframes (or the given ones); the outcomes."""
    out = []
    for i in frames:
        anchor = scene.T_cam_target[i] if anchors is None else anchors.get(i)
        anchor = anchor if scene.observations.key[i] else None
        out.append(fusion.advance(_motion(scene.observations.slam[i], epoch), anchor, 1.0))
    return out


class TestDissent:
    def test_counts_coherent_dissenters_and_concludes_at_the_fourth(self):
        dissent, aligned = Dissent(30.0, 4), _pose(0)
        for i in range(4):
            assert not dissent.is_conclusive
            assert dissent.update(_pose(180 - i), aligned)
            assert dissent.count == i + 1
        assert dissent.is_conclusive

    def test_an_agreeing_anchor_clears(self):
        dissent, aligned = Dissent(30.0, 4), _pose(0)
        dissent.update(_pose(180), aligned)
        assert not dissent.update(_pose(29), aligned)
        assert dissent.count == 0

    def test_an_incoherent_dissenter_restarts_at_one(self):
        dissent, aligned = Dissent(30.0, 4), _pose(0)
        dissent.update(_pose(180), aligned)
        dissent.update(_pose(180), aligned)
        dissent.update(_pose(90), aligned)
        assert dissent.count == 1

    def test_coherence_is_judged_after_propagation_by_the_aligned_rotation(self):
        dissent = Dissent(30.0, 4)
        for i in range(4):
            aligned = _pose(50 * i)
            assert dissent.update(lie.transform(aligned[:3, :3] @ HALF_TURN, aligned[:3, 3]), aligned)
        assert dissent.is_conclusive


class TestAreaConfidence:
    AREAS = np.array([100.0, 400.0, 100.0, 50.0])

    def test_is_the_area_over_its_running_mean_renormalised(self):
        confidence = AreaConfidence(FusionConfig(confidence="detection_area", confidence_exponent=2.0))
        got = [confidence.update(area) for area in self.AREAS]
        running_mean = np.cumsum(self.AREAS) / np.arange(1, 5)
        relative = (self.AREAS / running_mean) ** 2
        np.testing.assert_allclose(got, relative / (np.cumsum(relative) / np.arange(1, 5)))

    def test_does_not_depend_on_the_unit_of_area(self):
        a, b = (AreaConfidence(FusionConfig(confidence="detection_area")) for _ in range(2))
        np.testing.assert_allclose([a.update(x) for x in self.AREAS], [b.update(9 * x) for x in self.AREAS])

    @pytest.mark.parametrize("area", [np.nan, 0.0])
    def test_an_unknown_area_counts_one(self, area):
        assert AreaConfidence(FusionConfig(confidence="detection_area")).update(area) == 1.0

    def test_uniform_is_one(self):
        assert AreaConfidence(FusionConfig()).update(123.0) == 1.0


class TestRelativeMotion:
    def test_is_the_quotient_of_aligned_poses_in_any_alignment(self):
        rng = np.random.default_rng(0)
        T = lie.transform(lie.so3_exp(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
        scale, R_A, t_A = 1.8, lie.so3_exp(rng.normal(size=3)), rng.normal(size=3)
        aligned = [lie.inverse(lie.transform(R_A @ S[:3, :3], scale * R_A @ S[:3, 3] + t_A)) for S in T]
        step = relative_motion(_motion(T[0]), _motion(T[1]), scale)
        np.testing.assert_allclose(step, aligned[1] @ lie.inverse(aligned[0]), atol=1e-12)

    def test_needs_both_poses_of_one_epoch(self):
        a = _motion(np.eye(4))
        assert relative_motion(a, Motion.none(), 1.0) is None
        assert relative_motion(Motion.none(), a, 1.0) is None
        assert relative_motion(a, _motion(np.eye(4), epoch=1), 1.0) is None


class TestFusion:
    def test_the_solve_is_eq_causalfusion(self):
        """One anchor frame of a noisy run, solved again by scipy from the definition."""
        scene = make_scene(30, noise_deg=5, noise_m=0.1)
        fusion, poses = _fusion("pico_hat"), []
        anchors = {i: scene.observations.poses[i, 0] for i in range(0, 30, 4)}
        rng = np.random.default_rng(0)
        anchors = {
            i: lie.transform(lie.so3_exp(0.1 * rng.normal(size=3)) @ scene.T_cam_target[i, :3, :3], T[:3, 3])
            for i, T in anchors.items()
        }
        for i in range(25):
            anchor = anchors.get(i)
            fused = fusion.advance(_motion(scene.observations.slam[i]), anchor, 1.0)
            poses.append(fused.T_cam_target)
        S = [fusion.alignment.current.target_in_camera(scene.observations.slam[i]) for i in (23, 24)]
        M, predicted, w = anchors[24], S[1] @ lie.inverse(S[0]) @ poses[23], 0.1

        def residuals(x):
            R, t = lie.so3_exp(x[:3]) @ M[:3, :3], x[3:]
            E = predicted @ lie.inverse(lie.transform(R, t))
            return np.concatenate(
                [lie.so3_log(M[:3, :3] @ R.T), M[:3, 3] - t, w * lie.so3_log(E[:3, :3]), w * E[:3, 3]]
            )

        start = np.concatenate([np.zeros(3), M[:3, 3]])
        found = scipy.optimize.least_squares(
            residuals, start, loss="huber", f_scale=0.3, xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        np.testing.assert_allclose(poses[24][:3, :3], lie.so3_exp(found.x[:3]) @ M[:3, :3], atol=1e-7)
        np.testing.assert_allclose(poses[24][:3, 3], found.x[3:], atol=1e-7)
        assert 1e-3 < np.abs(poses[24] - M).max() < 0.2

    def test_between_anchors_the_pose_follows_the_aligned_motion_exactly(self):
        scene = make_scene(40)
        fusion = _fusion()
        outcomes = _feed(fusion, scene, range(40))
        for i in (30, 31, 33, 34):
            np.testing.assert_allclose(outcomes[i].T_cam_target, outcomes[i].predicted, atol=1e-14)
            assert np.isnan(outcomes[i].gate_weight)

    def test_the_gate_weakens_a_disagreeing_anchor(self):
        scene = make_scene(60)
        anchors = dict(enumerate(scene.T_cam_target))
        anchors[40] = lie.transform(anchors[40][:3, :3] @ HALF_TURN, anchors[40][:3, 3])
        outcomes = _feed(_fusion("pico_hat"), scene, range(60), anchors)
        assert outcomes[40].gate_weight == 0.05
        assert outcomes[36].gate_weight == outcomes[44].gate_weight == 1.0

    @pytest.mark.parametrize(("weights", "expected"), [({"gate_weight": 0.0}, 0.0), ({"relative_weight": 0.0}, 180.0)])
    def test_zero_weights_leave_the_other_side_alone(self, weights, expected):
        scene = make_scene(60)
        anchors = dict(enumerate(scene.T_cam_target))
        anchors[40] = lie.transform(anchors[40][:3, :3] @ HALF_TURN, anchors[40][:3, 3])
        outcomes = _feed(_fusion("pico_hat", fusion=weights), scene, range(60), anchors)
        np.testing.assert_allclose(
            rotation_error_deg(outcomes[40].T_cam_target, scene.T_cam_target[40]), expected, atol=1e-4
        )

    def test_a_new_slam_epoch_voids_the_alignment_and_ties_nothing_across(self):
        scene = make_scene(80)
        fusion = _fusion()
        _feed(fusion, scene, range(40))
        assert fusion.alignment.current.epoch == 0
        outcomes = _feed(fusion, scene, range(40, 80), epoch=1)
        assert outcomes[0].T_cam_target is not None
        assert outcomes[1].T_cam_target is None
        assert fusion.alignment.current.epoch == 1
        assert not any(outcome.reset for outcome in outcomes)
        for i in range(13, 40):
            np.testing.assert_allclose(outcomes[i].T_cam_target, scene.T_cam_target[40 + i], atol=1e-8)

    def test_confidence_multiplies_the_anchor(self):
        """A confident anchor pulls harder."""
        scene = make_scene(40)
        offset = lie.transform(lie.so3_exp(np.array([0.05, 0, 0])), np.zeros(3))
        pulls = []
        for confidence in (0.1, 1.0, 10.0):
            fusion = _fusion("pico_hat", fusion={"relative_weight": 1.0})
            _feed(fusion, scene, range(36))
            anchor = offset @ scene.T_cam_target[36]
            fused = fusion.advance(_motion(scene.observations.slam[36]), anchor, confidence)
            pulls.append(rotation_error_deg(fused.T_cam_target, anchor))
        assert pulls[0] > 2 * pulls[1] > 4 * pulls[2]
