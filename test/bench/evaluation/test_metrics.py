"""Metrics against values worked out by hand."""

import numpy as np
import pytest

from hat_ros.bench.evaluation import metrics
from hat_ros.geometry import lie
from hat_ros.types import TrackState


def pose(rotvec_deg=(0, 0, 0), t=(0, 0, 10.0)):
    return lie.transform(lie.so3_exp(np.radians(rotvec_deg)), np.array(t, dtype=float))


NONE = np.full((4, 4), np.nan)


def test_pose_errors_are_the_papers_formulas():
    est = np.array([pose((0, 0, 30), (3, 0, 14)), pose(), NONE, pose()])
    true = np.array([pose((0, 0, 0), (0, 0, 10)), pose(), pose(), NONE])
    errors = metrics.pose_errors(est, true)
    np.testing.assert_allclose(errors.translation_m[:2], [5.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(errors.rotation_rad[:2], [np.pi / 6, 0.0], atol=1e-12)
    np.testing.assert_allclose(errors.pose[:2], [np.pi / 6 + 0.5, 0.0], atol=1e-12)
    assert np.isnan(errors.pose[2:]).all(), "a missing output or truth is never an error of zero"


def test_rotation_error_ignores_the_sign_of_the_quaternion_and_reaches_180():
    est = np.array([pose((180, 0, 0)), pose((0, 179.9999, 0))])
    true = np.array([pose(), pose()])
    np.testing.assert_allclose(np.degrees(metrics.pose_errors(est, true).rotation_rad), [180.0, 179.9999], atol=1e-6)


def test_summary_uses_sample_sd_and_skips_missing():
    est = np.array([pose((0, 0, 10)), pose((0, 0, 20)), pose((0, 0, 120)), NONE])
    summary = metrics.summarise(metrics.pose_errors(est, np.array([pose()] * 4)))
    assert summary["E_q_deg_mean"] == pytest.approx(50.0)
    assert summary["E_q_deg_sd"] == pytest.approx(np.std([10, 20, 120], ddof=1))
    assert summary["E_q_over_90_share"] == pytest.approx(1 / 3)
    assert summary["E_t_m_mean"] == pytest.approx(0.0, abs=1e-12)


def test_summary_without_any_output_is_nan_not_zero():
    summary = metrics.summarise(metrics.pose_errors(np.array([NONE]), np.array([pose()])))
    assert all(np.isnan(value) for value in summary.values())


def test_coverage_counts_missing_outputs_against_it():
    has, truth = np.array([True, True, False, True]), np.array([True, True, True, False])
    assert metrics.coverage(has, truth) == {"targets": 3, "valid": 2, "coverage": pytest.approx(2 / 3)}
    assert metrics.coverage(has, np.zeros(4, bool))["targets"] == 4


def test_add_s_is_zero_for_a_symmetry_and_the_shift_for_a_far_point():
    square = np.array([[1, 1, 0], [-1, 1, 0], [1, -1, 0], [-1, -1, 0]], dtype=float)
    flipped = np.array([pose((0, 0, 180))])
    np.testing.assert_allclose(metrics.add_s(square, flipped, np.array([pose()])), [0.0], atol=1e-12)
    one = np.zeros((1, 3))
    np.testing.assert_allclose(metrics.add_s(one, np.array([pose(t=(3, 4, 10))]), np.array([pose()])), [5.0])
    assert np.isnan(metrics.add_s(one, np.array([NONE]), np.array([pose()]))).all()


def test_candidate_oracle_takes_the_best_of_k_and_counts_empty_keyframes_as_misses():
    rows = lie.row_from_matrix(np.array([pose((0, 0, 120)), pose((0, 0, 20))]))
    truth = np.array([pose(), pose(), NONE])
    oracle = metrics.candidate_oracle([rows, np.zeros((0, 7)), rows], truth)
    assert oracle["oracle_keyframes"] == 2
    assert oracle["oracle_within_15_share"] == 0.0
    assert oracle["oracle_within_30_share"] == 0.5
    assert oracle["oracle_median_deg"] == pytest.approx(100.0)


def test_candidate_oracle_ignores_candidates_that_are_not_finite():
    rows = np.vstack([np.full(7, np.nan), lie.row_from_matrix(pose((0, 0, 10)))])
    assert metrics.best_of_k_deg([rows], np.array([pose()]))[0] == pytest.approx(10.0)


def test_range_bins_hold_signed_depth_errors():
    true = np.array([pose(t=(0, 0, 3.0))] * 3 + [pose(t=(0, 0, 7.0))])
    est = np.array([pose(t=(0, 0, 2.9)), pose(t=(0, 0, 2.8)), pose(t=(0, 0, 3.3)), pose((0, 100, 0), (0, 0, 8.0))])
    near, far = metrics.range_bins(est, true)
    assert (near["depth_from_m"], near["depth_to_m"], near["frames"]) == (2.0, 4.0, 3)
    assert near["depth_m_median"] == pytest.approx(-0.1)
    assert (near["depth_m_q25"], near["depth_m_q75"]) == (pytest.approx(-0.15), pytest.approx(0.1))
    assert far["rotation_deg_median"] == pytest.approx(100.0)
    assert far["over_90_share"] == 1.0


def test_depth_energy_share():
    true = np.array([pose(), pose()])
    est = np.array([pose(t=(1, 0, 10)), pose(t=(0, 0, 13))])
    assert metrics.depth_energy_share(est, true) == pytest.approx(0.9)


def test_inside_ellipsoid_follows_the_chi_square_quantile():
    # For one axis: error^2 / variance against chi2(6) at 95 % = 12.5916.
    covariance = np.eye(6)
    est = np.array([pose(), pose(), pose()])
    true = np.array([pose(t=(3.54, 0, 10)), pose(t=(3.56, 0, 10)), NONE])
    flags = metrics.inside_ellipsoid(est, np.array([covariance] * 3), true)
    assert flags.tolist() == [True, False]


def test_inside_ellipsoid_uses_the_stated_rotation_convention():
    # A tight axis: rotation about x known well, about z poorly; R_true = Exp(rotvec) R_est.
    covariance = np.diag([1, 1, 1, 1e-6, 1e-6, 1.0])
    est = np.array([pose((90, 0, 0)), pose((90, 0, 0))])
    about_z = lie.transform(lie.so3_exp(np.array([0, 0, 0.2])), np.zeros(3)) @ est[0]
    about_x = lie.transform(lie.so3_exp(np.array([0.2, 0, 0])), np.zeros(3)) @ est[0]
    true = np.array([about_z, about_x])
    true[:, :3, 3] = est[:, :3, 3]
    assert metrics.inside_ellipsoid(est, np.array([covariance] * 2), true).tolist() == [True, False]


def test_a_singular_covariance_claims_certainty():
    est, true = np.array([pose()] * 2), np.array([pose(), pose(t=(0, 0, 10.1))])
    assert metrics.inside_ellipsoid(est, np.zeros((2, 6, 6)), true).tolist() == [True, False]


def test_untrue_tracking_share():
    est = np.array([pose((0, 0, a)) for a in (40, 50, 5, 60)])
    errors = metrics.pose_errors(est, np.array([pose()] * 4))
    states = np.array([TrackState.TRACKING, TrackState.COASTING, TrackState.TRACKING, TrackState.COASTING])
    assert metrics.untrue_tracking_share(states, errors) == pytest.approx(1 / 3)
    assert np.isnan(metrics.untrue_tracking_share(states, metrics.pose_errors(est, est)))


def test_relative_motion_is_blind_to_the_slam_gauge_and_skips_epochs():
    rng = np.random.default_rng(0)
    T_true = np.array([pose(rng.normal(size=3) * 20) for _ in range(6)])
    gauge = pose((10, 20, 30), (1, 2, 3))
    T_slam_cam = gauge @ lie.inverse(T_true)
    valid, epoch = np.ones(6, bool), np.array([0, 0, 0, 1, 1, 1])
    valid[5] = False
    T_slam_cam[4, :3, :3] = T_slam_cam[4, :3, :3] @ lie.so3_exp(np.radians([0, 0, 2.0]))
    rows = lie.row_from_matrix(T_slam_cam)
    rows[5] = np.nan
    np.testing.assert_allclose(metrics.relative_motion_deg(rows, valid, epoch, T_true), [0, 0, 2.0], atol=1e-6)


def test_mask_summary_leaves_out_frames_that_cannot_be_judged():
    assert metrics.mask_summary(np.array([0.95, 0.85, np.nan])) == {
        "mask_iou_mean": pytest.approx(0.9),
        "mask_iou_over_0_9_share": 0.5,
    }
