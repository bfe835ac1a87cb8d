"""The similarity fit: planted ones come back, the closed form is the optimum, and the history stays bounded."""

import numpy as np
import pytest
import scipy.optimize

from hat_ros.config import AlignmentConfig
from hat_ros.core.alignment import SlamAlignment, umeyama
from hat_ros.core.joint_history import JointHistory, relative_rotvecs, rotation_mean
from hat_ros.geometry import lie


def _planted(seed, n=40, noise_deg=0.0, noise_m=0.0, scale=2.5, turn_deg=1.5, outliers=0):
    """Joint observations (anchor, SLAM pose) of a known similarity; the first anchors may be half-turned."""
    rng = np.random.default_rng(seed)
    R_A, t_A = lie.so3_exp(rng.normal(size=3)), rng.normal(size=3)
    out = []
    for i in range(n):
        R = lie.so3_exp(np.radians(turn_deg) * i * np.array([0.3, 1, 0.2])) @ lie.so3_exp(np.array([0.5, 0.1, 2.0]))
        T_cam_target = lie.transform(R, np.array([0.3 * np.sin(i / 9), 0.1, 8 - 0.03 * i]))
        T_target_cam = lie.inverse(T_cam_target)
        T_slam_cam = lie.transform(R_A.T @ T_target_cam[:3, :3], R_A.T @ (T_target_cam[:3, 3] - t_A) / scale)
        basin = lie.so3_exp(np.array([0, np.pi, 0])) if i % 7 == 3 and i < 7 * outliers else np.eye(3)
        noisy = lie.so3_exp(np.radians(noise_deg) * rng.normal(size=3)) @ R @ basin
        out.append((lie.transform(noisy, T_cam_target[:3, 3] + noise_m * rng.normal(size=3)), T_slam_cam))
    return out, (scale, R_A, t_A)


def _fitted(observations, **config):
    alignment = SlamAlignment(AlignmentConfig(**config))
    for anchor, T_slam_cam in observations:
        alignment.observe(anchor, T_slam_cam)
    alignment.update(epoch=0)
    return alignment


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("n", [3, 4, 40])
def test_a_planted_similarity_is_recovered(seed, n):
    observations, (scale, R_A, t_A) = _planted(seed, n)
    alignment = _fitted(observations)
    np.testing.assert_allclose(alignment.current.scale, scale, rtol=1e-8)
    np.testing.assert_allclose(alignment.current.R_target_slam, R_A, atol=1e-9)
    np.testing.assert_allclose(alignment.current.translation_m, t_A, atol=1e-7)
    for anchor, T_slam_cam in observations:
        np.testing.assert_allclose(alignment.current.target_in_camera(T_slam_cam), anchor, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_it_survives_half_turned_anchors(seed):
    observations, (scale, R_A, _) = _planted(seed, 60, noise_deg=1.0, noise_m=0.02, outliers=6)
    alignment = _fitted(observations)
    assert alignment.current.n_anchors <= 54
    assert np.degrees(lie.angle_between(alignment.current.R_target_slam, R_A)) < 1.0
    np.testing.assert_allclose(alignment.current.scale, scale, rtol=0.05)


def _residuals(parameters, observations):
    """Eq. (alignmentfit) as the paper writes it."""
    scale, R_A, t_A = np.exp(parameters[0]), lie.so3_exp(parameters[1:4]), parameters[4:]
    out = []
    for anchor, T_slam_cam in observations:
        R_F, t_F = R_A @ T_slam_cam[:3, :3], scale * R_A @ T_slam_cam[:3, 3] + t_A
        out.extend(lie.so3_log(anchor[:3, :3] @ R_F))
        out.extend(anchor[:3, 3] + R_F.T @ t_F)
    return np.array(out)


@pytest.mark.parametrize("seed", range(4))
def test_the_closed_form_is_the_levenberg_marquardt_minimum(seed):
    observations, _ = _planted(seed, 30, noise_deg=5.0, noise_m=0.1)
    fit = _fitted(observations, first_rejection_rounds=0).current
    ours = np.concatenate([[np.log(fit.scale)], lie.so3_log(fit.R_target_slam), fit.translation_m])
    start = ours + 0.1 * np.random.default_rng(seed).normal(size=7)
    found = scipy.optimize.least_squares(
        _residuals, start, args=(observations,), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    np.testing.assert_allclose(ours, found.x, atol=1e-6)
    np.testing.assert_allclose(fit.rms**2 * 30, 2 * found.cost, rtol=1e-9)


def test_gauge_and_scale_of_slam_change_nothing_in_metres():
    observations, _ = _planted(1, 30, noise_deg=3.0, noise_m=0.05)
    gauge = lie.transform(lie.so3_exp(np.array([1.0, -0.4, 2.0])), np.array([3.0, -1.0, 2.0]))
    changed = []
    for anchor, T_slam_cam in observations:
        T = gauge @ T_slam_cam
        T[:3, 3] *= 0.37
        changed.append((anchor, T))
    a, b = _fitted(observations), _fitted(changed)
    for (_, T), (_, T_changed) in zip(observations, changed, strict=True):
        np.testing.assert_allclose(a.current.target_in_camera(T), b.current.target_in_camera(T_changed), atol=1e-9)


def test_schedule_first_at_three_then_every_ten_frames_anchor_or_not():
    observations, _ = _planted(0, 12)
    alignment, versions = SlamAlignment(AlignmentConfig()), []
    for frame in range(45):
        if frame % 4 == 0:
            alignment.observe(*observations[frame // 4])
        alignment.update(epoch=0)
        versions.append(0 if alignment.current is None else alignment.current.version)
    changes = [frame for frame in range(1, 45) if versions[frame] != versions[frame - 1]]
    assert changes == [8, 18, 28, 38]
    assert alignment.current.n_anchors <= 10


def test_a_stationary_target_keeps_scale_one_and_still_fits():
    R_A = lie.so3_exp(np.array([0.2, 1.0, -0.5]))
    T = lie.transform(lie.so3_exp(np.array([0.1, 0.2, 0.3])), np.array([0.0, 0.1, 6.0]))
    T_slam_cam = lie.transform((T[:3, :3] @ R_A).T, np.zeros(3))
    alignment = _fitted([(T, T_slam_cam)] * 4)
    assert alignment.current.scale == 1.0
    np.testing.assert_allclose(alignment.current.target_in_camera(T_slam_cam), T, atol=1e-9)


def test_scale_never_turns_negative():
    observations, _ = _planted(0, 10)
    backwards = []
    for anchor, T_slam_cam in observations:
        T = T_slam_cam.copy()
        T[:3, 3] = -T[:3, 3]
        backwards.append((anchor, T))
    assert _fitted(backwards).current.scale > 0


def test_reset_drops_the_fit_and_versions_go_on():
    observations, _ = _planted(0, 10)
    alignment = _fitted(observations)
    alignment.reset()
    assert alignment.current is None
    assert alignment.n_observations == 0
    for anchor, T_slam_cam in observations[:3]:
        alignment.observe(anchor, T_slam_cam)
    alignment.update(epoch=2)
    assert (alignment.current.version, alignment.current.epoch, alignment.current.n_anchors) == (2, 2, 3)


def test_a_plain_refit_takes_all_observations_and_a_robust_one_leaves_outliers_out():
    observations, _ = _planted(5, 40, noise_deg=1.0, outliers=5)
    counts = []
    for rejections in (0, 1):
        alignment = SlamAlignment(AlignmentConfig(refit_rejection_rounds=rejections))
        for anchor, T_slam_cam in observations:
            alignment.observe(anchor, T_slam_cam)
            alignment.update(epoch=0)
        # The last fit saw 33 of them: three frames' worth, then one fit every ten.
        counts.append(alignment.current.n_anchors)
    assert counts == [33, 28]


def test_an_observation_may_be_fitted_to_without_counting():
    observations, _ = _planted(0, 4)
    alignment = SlamAlignment(AlignmentConfig())
    for i, (anchor, T_slam_cam) in enumerate(observations):
        alignment.observe(anchor, T_slam_cam, counts=i > 0)
        alignment.update(epoch=0)
        assert (alignment.current is None) == (i < 3)
    assert alignment.n_observations == 3
    assert alignment.current.n_anchors == 4


class TestBoundedHistory:
    @pytest.mark.parametrize("rejections", [0, 1], ids=["as published", "robust"])
    def test_folding_stays_within_tolerance_of_the_full_refit(self, rejections):
        observations, _ = _planted(3, 900, noise_deg=3.0, noise_m=0.05, outliers=40)
        full, bounded = (
            SlamAlignment(AlignmentConfig(max_observations=m, refit_rejection_rounds=rejections)) for m in (10_000, 64)
        )
        for anchor, T_slam_cam in observations:
            for alignment in (full, bounded):
                alignment.observe(anchor, T_slam_cam)
                alignment.update(epoch=0)
        assert bounded.n_observations == 900
        assert len(bounded._history) <= 64
        a, b = full.current, bounded.current
        assert np.degrees(lie.angle_between(a.R_target_slam, b.R_target_slam)) < 0.02
        np.testing.assert_allclose(b.scale, a.scale, rtol=1e-3)
        T_slam_cam = observations[-1][1]
        moved = a.target_in_camera(T_slam_cam)[:3, 3] - b.target_in_camera(T_slam_cam)[:3, 3]
        assert np.linalg.norm(moved) < 0.01

    def test_without_noise_folding_loses_nothing(self):
        observations, (scale, R_A, t_A) = _planted(4, 300)
        fit = _fitted(observations, max_observations=16).current
        np.testing.assert_allclose(fit.scale, scale, rtol=1e-8)
        np.testing.assert_allclose(fit.R_target_slam, R_A, atol=1e-8)
        np.testing.assert_allclose(fit.translation_m, t_A, atol=1e-6)

    def test_below_capacity_nothing_is_folded(self):
        history = JointHistory(2048)
        for anchor, T_slam_cam in _planted(0, 200)[0]:
            history.append(anchor, T_slam_cam)
        assert (len(history), history.folded_count) == (200, 0)
        assert AlignmentConfig().max_observations == 2048

    def test_memory_does_not_grow(self):
        history, sizes = JointHistory(32), set()
        observation = _planted(0, 1)[0][0]
        for _ in range(1000):
            history.append(*observation)
            sizes.add(history._data.nbytes)
        assert max(sizes) == 32 * 13 * 8


class TestRotationMean:
    def test_of_symmetric_rotations_is_their_centre(self):
        centre = lie.so3_exp(np.array([0.4, -1.0, 2.0]))
        spread = np.array([[0.3, 0, 0], [-0.3, 0, 0], [0, 0.5, 0], [0, -0.5, 0]])
        quats = lie.quat_from_matrix(centre @ lie.so3_exp(spread))
        mean = rotation_mean(quats, np.ones(4), quats[0])
        np.testing.assert_allclose(lie.matrix_from_quat(mean), centre, atol=1e-12)

    def test_does_not_care_for_quaternion_signs(self):
        rng = np.random.default_rng(0)
        quats = lie.quat_from_matrix(lie.so3_exp(rng.normal(size=(9, 3)) * 0.3))
        signs = rng.choice([-1.0, 1.0], size=(9, 1))
        np.testing.assert_allclose(
            rotation_mean(quats * signs, np.ones(9), -quats[0]), rotation_mean(quats, np.ones(9), quats[0]), atol=1e-13
        )

    def test_weights_count_like_repetitions(self):
        rng = np.random.default_rng(1)
        quats = lie.quat_from_matrix(lie.so3_exp(rng.normal(size=(4, 3)) * 0.4))
        repeated = np.repeat(quats, [1, 3, 2, 5], axis=0)
        np.testing.assert_allclose(
            rotation_mean(quats, np.array([1.0, 3, 2, 5]), quats[0]),
            rotation_mean(repeated, np.ones(11), quats[0]),
            atol=1e-12,
        )

    def test_starts_half_a_turn_away_still_arrive(self):
        quat = lie.quat_from_matrix(lie.so3_exp(np.array([0.1, 0.2, 0.3])))
        away = lie.quat_from_matrix(lie.matrix_from_quat(quat) @ lie.so3_exp(np.array([0, np.pi, 0])))
        mean = rotation_mean(quat[None], np.ones(1), away)
        np.testing.assert_allclose(relative_rotvecs(mean[None], quat), 0.0, atol=1e-12)


def test_umeyama_recovers_scale_and_rotation_and_says_one_when_there_is_no_scale():
    rng = np.random.default_rng(0)
    points, R = rng.normal(size=(6, 3)), lie.so3_exp(np.array([0.5, 2.0, -1.0]))
    scale, quat_xyzw = umeyama(points, 1.7 * points @ R.T + [1, 2, 3])
    np.testing.assert_allclose(scale, 1.7, rtol=1e-12)
    np.testing.assert_allclose(lie.matrix_from_quat(quat_xyzw), R, atol=1e-12)
    assert umeyama(points, np.ones((6, 3)))[0] == 1.0
    assert umeyama(np.ones((6, 3)), points)[0] == 1.0
