"""What a coarse pose says of an image and of candidates, against samples of its own distribution."""

import numpy as np
import pytest

from hat_ros.config import PriorConfig, config_from_dict
from hat_ros.core.initial_pose import Acquisition, InitialPose
from hat_ros.errors import InputError
from hat_ros.geometry import lie
from hat_ros.types import Camera, Candidates, PosePrior

CAMERA = Camera(np.array([[800.0, 2.0, 319.5], [0, 700.0, 239.5], [0, 0, 1]]), 640, 480)
R0 = lie.so3_exp(np.array([0.3, -0.8, 0.4]))
UNKNOWN = 3.0  # rad


def given(position=(0.4, -0.3, 10.0), sigma=(0.2, 0.3, 0.8, 0.1, 0.2, 0.3), R=R0):
    row = lie.row_from_matrix(lie.transform(R, np.array(position)))
    return InitialPose(row, np.diag(np.square(sigma)))


def correlated():
    """Bearing known, range not: the long axis points at the camera."""
    line = np.array([0.4, -0.3, 10.0]) / np.linalg.norm([0.4, -0.3, 10.0])
    covariance = np.diag([0.0004, 0.0004, 0.0004, 1, 1, 1]).astype(float)
    covariance[:3, :3] += 4.0 * np.outer(line, line)
    return InitialPose(lie.row_from_matrix(lie.transform(R0, np.array([0.4, -0.3, 10.0]))), covariance)


def samples(pose, n=20000):
    """Poses of the distribution (n, 4, 4), and their Mahalanobis distances in position and in rotation."""
    rng = np.random.default_rng(3)
    error = rng.multivariate_normal(np.zeros(6), pose.covariance, n)
    T = lie.transform(lie.so3_exp(error[:, 3:]) @ pose.R_cam_target, pose.pose_row[:3] + error[:, :3])
    blocks = (pose.covariance[:3, :3], pose.covariance[3:, 3:])
    parts = (error[:, :3], error[:, 3:])
    return T, [np.sqrt(np.einsum("ni,ij,nj->n", e, np.linalg.inv(P), e)) for e, P in zip(parts, blocks, strict=True)]


@pytest.mark.parametrize("pose", [given(), correlated()], ids=["axes", "line of sight"])
def test_the_region_is_the_tight_box_of_the_ellipsoid(pose):
    reach_m = 1.0
    T, (distance, _) = samples(pose)
    # Onto the surface of 3 sigma.
    points = pose.pose_row[:3] + (T[:, :3, 3] - pose.pose_row[:3]) * (3.0 / distance)[:, None]
    points = points[points[:, 2] > reach_m]
    uv = CAMERA.project(points)
    region = pose.region(CAMERA, reach_m)
    low, high = region.center_xyxy[:2], region.center_xyxy[2:]
    span = high - low
    assert (uv.min(axis=0) >= low - 1e-2 * span).all() and (uv.max(axis=0) <= high + 1e-2 * span).all()
    np.testing.assert_allclose(uv.min(axis=0), low, atol=0.06 * span.max())
    np.testing.assert_allclose(uv.max(axis=0), high, atol=0.06 * span.max())


def test_the_window_holds_all_of_the_target_and_little_else():
    pose, reach_m = given(sigma=(0.001, 0.001, 0.001, 3, 3, 3)), 1.0
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(40000, 3))
    points = pose.pose_row[:3] + reach_m * direction / np.linalg.norm(direction, axis=1)[:, None]
    uv = CAMERA.project(points)
    x0, y0, x1, y1 = pose.region(CAMERA, reach_m).window_xyxy
    assert (uv.min(axis=0) >= (x0, y0)).all() and (uv.max(axis=0) <= (x1 - 1, y1 - 1)).all()
    assert (uv.min(axis=0) - (x0, y0) < 3).all() and ((x1 - 1, y1 - 1) - uv.max(axis=0) < 3).all()
    largest = pose.region(CAMERA, reach_m).largest_px
    assert np.ptp(uv, axis=0).max() <= largest < 1.03 * np.ptp(uv, axis=0).max()


@pytest.mark.parametrize(
    ("pose", "window"),
    [
        (given(sigma=(100, 100, 100, 3, 3, 3)), (0, 0, 640, 480)),
        (given(position=(30, 0, 10), sigma=(0.1, 0.1, 0.1, 1, 1, 1)), None),
    ],
    ids=["nothing known", "out of sight"],
)
def test_the_window_is_what_the_image_shows(pose, window):
    region = pose.region(CAMERA, 1.0)
    assert region.is_empty if window is None else region.window_xyxy == window


def test_the_gate_holds_the_share_of_3_sigma():
    pose = given()
    T, _ = samples(pose)
    assert pose.admits(T).mean() == pytest.approx(0.9973**2, abs=2e-3)
    away = T.copy()
    away[:, 0, 3] += 1.5
    assert pose.admits(away).mean() < 0.01
    turned = T.copy()
    turned[:, :3, :3] = lie.so3_exp(np.array([1.0, 0, 0])) @ T[:, :3, :3]
    assert pose.admits(turned).mean() < 0.01


def test_an_unknown_rotation_is_no_gate():
    pose = given(sigma=(0.2, 0.2, 0.2, UNKNOWN, UNKNOWN, UNKNOWN))
    any_turn = lie.matrix_from_quat(np.random.default_rng(0).normal(size=(500, 4)))
    assert pose.admits(lie.transform(any_turn, np.tile(pose.pose_row[:3], (500, 1)))).all()
    assert pose.as_start(5) is None and given().as_start(5).stamp_ns == 5


def test_about_an_axis_of_which_nothing_is_known_any_turn_is_right_and_a_tilt_is_not():
    pose = given(sigma=(0.2, 0.2, 0.2, 0.05, 0.05, UNKNOWN))
    angles = np.linspace(-np.pi, np.pi, 73)
    about = lie.so3_exp(angles[:, None] * np.array([0, 0, 1.0]))
    place = np.tile(pose.pose_row[:3], (73, 1))
    for tilt_rad, right in ((0.1, True), (0.25, False)):
        tilts = lie.so3_exp(np.array([0.6, 0.8, 0.0]) * tilt_rad)
        for turn in (tilts @ about, about @ tilts):
            assert (pose.admits(lie.transform(turn @ R0, place)) == right).all()


def test_candidates_that_it_contradicts_are_gone():
    pose = given()
    rows = np.stack([pose.pose_row, pose.pose_row + np.array([0, 0, 5, 0, 0, 0, 0]), np.full(7, np.nan)])
    kept = pose.keep(Candidates(rows, np.array([1.0, 2.0, 3.0])))
    np.testing.assert_array_equal(kept.pose_rows, pose.pose_row[None])
    assert len(pose.keep(Candidates(rows[1:], np.array([2.0, 3.0])))) == 0


@pytest.mark.parametrize(
    ("row", "covariance", "sentence"),
    [
        (np.zeros(7), np.eye(6), "norm 1"),
        (np.array([0, 0, np.inf, 0, 0, 0, 1]), np.eye(6), "7 finite numbers"),
        (np.array([0, 0, 5.0, 0, 0, 0, 1]), np.zeros((6, 6)), "positive definite"),
        (np.array([0, 0, 5.0, 0, 0, 0, 1]), np.eye(6) + np.eye(6, k=1), "symmetric"),
        (np.array([0, 0, 5.0, 0, 0, 0, 1]), np.full((6, 6), np.nan), "finite"),
        (np.array([0, 0, -5.0, 0, 0, 0, 1]), np.eye(6), "behind the camera"),
    ],
)
def test_what_is_no_pose_is_refused(row, covariance, sentence):
    with pytest.raises(InputError, match=sentence):
        InitialPose(row, covariance)


def acquisition(feedback=True):
    section = {"pose": "0 0 5 0 0 0 1", "sigma": "1 1 1 1 1 1"}
    return Acquisition(config_from_dict({"initial_pose": section, "prior": {"enabled": feedback}}))


PRIOR = PosePrior(1, given().pose_row, given().pose_row, healthy=False, supported=False)


def test_it_serves_until_the_target_has_a_pose_and_never_again():
    stage = acquisition()
    assert stage.at(None) is not None
    stage.found()
    assert stage.at(None) is not None
    assert stage.at(PRIOR) is None
    assert stage.at(None) is None


def test_without_feedback_it_serves_until_something_was_found():
    assert PriorConfig().enabled
    stage = acquisition(feedback=False)
    assert stage.at(None) is not None
    stage.found()
    assert stage.at(None) is None


def test_a_new_search_does_not_go_by_an_old_pose():
    stage = acquisition()
    stage.reset()  # before anything was looked at
    assert stage.at(None) is not None
    stage.reset()
    assert stage.at(None) is None
