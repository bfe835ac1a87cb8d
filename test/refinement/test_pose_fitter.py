"""Rounds of render, contour and iterations on the pictures of one spacecraft."""

import numpy as np
import pytest
from shape_scene import CAMERA, picture, pose_errors, random_pose, spacecraft

from hat_ros.geometry import lie
from hat_ros.refinement.mask_field import MaskField
from hat_ros.refinement.pose_fitter import WITH_MASK, WITHOUT_MASK, PoseFitter, Schedule
from hat_ros.refinement.view import TargetViewer
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.types import RotationPrior

BLACK = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
ASIDE = lie.so3_exp(np.radians([2.0, -2.0, 1.0]))


@pytest.fixture(scope="module")
def viewer():
    return TargetViewer(spacecraft())


@pytest.fixture(scope="module")
def fitter(viewer):
    return PoseFitter(viewer, 160, 300)


@pytest.mark.parametrize("shift_px", [(30, -20), (-60, 10)])
def test_centring_finds_a_target_that_has_drifted(viewer, fitter, shift_px):
    T_true = random_pose(np.random.default_rng(6), viewer.target)
    field = MaskField(RayRenderer(viewer.target).render(T_true, CAMERA, color=False).mask)
    start = T_true.copy()
    start[:2, 3] += np.array(shift_px) * T_true[2, 3] / CAMERA.K[0, 0]
    centred = fitter.centred(start, CAMERA, field, BLACK)
    assert np.abs(centred[:2, 3] - T_true[:2, 3]).max() < 4 * T_true[2, 3] / CAMERA.K[0, 0]
    np.testing.assert_array_equal(centred[:3, :3], T_true[:3, :3])


@pytest.mark.parametrize("rounds", [WITH_MASK, WITHOUT_MASK])
def test_a_fit_returns_to_the_pose_and_supports_it(viewer, fitter, rounds):
    T_true = random_pose(np.random.default_rng(3), viewer.target)
    frame, mask = picture(viewer.target, T_true)
    field = MaskField(mask) if rounds is WITH_MASK else None
    start = lie.transform(ASIDE @ T_true[:3, :3], T_true[:3, 3])
    fit = fitter.fit(start, CAMERA, frame.rgb, field, rounds)
    turn_deg, shift = pose_errors(fit.T_cam_target, T_true)
    assert turn_deg < 0.7 and shift < 0.005
    assert fit.support > 0.9
    outline = np.count_nonzero(fit.shown.mask) / fit.view.scale**2
    assert outline == pytest.approx(np.count_nonzero(mask), rel=0.03)


def test_a_certain_prior_holds_the_rotation(viewer, fitter):
    T_true = random_pose(np.random.default_rng(3), viewer.target)
    frame, mask = picture(viewer.target, T_true)
    R_start = ASIDE @ T_true[:3, :3]
    prior = RotationPrior(R_start, np.radians(1e-3) ** -2 * np.eye(3))
    fit = fitter.fit(lie.transform(R_start, T_true[:3, 3]), CAMERA, frame.rgb, MaskField(mask), WITH_MASK, prior)
    assert np.degrees(lie.angle_between(fit.T_cam_target[:3, :3], R_start)) < 0.01


def test_a_target_out_of_view_has_no_fit(fitter):
    behind = lie.transform(np.eye(3), np.array([0.0, 0.0, -5.0]))
    assert fitter.fit(behind, CAMERA, np.zeros((*BLACK.shape, 3), np.uint8), None, WITHOUT_MASK) is None


def test_scaling_a_schedule_scales_the_mask_alone():
    schedule = Schedule((4, 3), (2, 1), (10, 6))
    assert schedule.scaled(0.5) == Schedule((4, 3), (2, 1), (5, 3))
