"""Laws of the geometry, near the identity and at half a turn included."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hat_ros.geometry import lie

axes = (
    st.tuples(*[st.floats(-1, 1)] * 3)
    .filter(lambda v: np.linalg.norm(v) > 1e-3)
    .map(lambda v: np.array(v) / np.linalg.norm(v))
)
angles = st.one_of(st.floats(0, np.pi), st.floats(0, 1e-6), st.floats(0, 1e-6).map(lambda e: np.pi - e), st.just(np.pi))


LAWS = settings(deadline=None, derandomize=True, max_examples=60)


@LAWS
@given(axes, angles)
def test_exp_agrees_with_an_independent_implementation(axis, angle):
    np.testing.assert_allclose(lie.so3_exp(axis * angle), Rotation.from_rotvec(axis * angle).as_matrix(), atol=1e-14)


@LAWS
@given(axes, angles)
def test_log_inverts_exp_up_to_half_a_turn(axis, angle):
    R = lie.so3_exp(axis * angle)
    rotvec = lie.so3_log(R)
    np.testing.assert_allclose(np.linalg.norm(rotvec), angle, atol=2e-8)
    np.testing.assert_allclose(lie.so3_exp(rotvec), R, atol=1e-14)


@LAWS
@given(axes, angles)
def test_one_pose_and_a_batch_give_the_same(axis, angle):
    rotvec = axis * angle
    R = lie.so3_exp(rotvec)
    for function, value in (
        (lie.so3_exp, rotvec),
        (lie.so3_log, R),
        (lie.quat_from_matrix, R),
        (lie.rotation_angle, R),
        (lie.so3_right_jacobian_inverse, rotvec * 0.9),
        (lie.matrix_from_quat, lie.quat_from_matrix(R)),
    ):
        np.testing.assert_allclose(function(value), function(value[None])[0], atol=1e-13, rtol=1e-13)


@LAWS
@given(axes, angles)
def test_a_quaternion_and_its_negative_are_one_rotation(axis, angle):
    q = lie.quat_from_matrix(lie.so3_exp(axis * angle))
    assert q[3] >= 0
    np.testing.assert_array_equal(lie.matrix_from_quat(q), lie.matrix_from_quat(-q))
    np.testing.assert_allclose(lie.quat_from_matrix(lie.matrix_from_quat(-q)) @ q, 1.0, atol=1e-14)


@LAWS
@given(axes, st.floats(0, 3.0), axes)
def test_right_jacobian_inverse_is_the_derivative_of_log(axis, angle, direction):
    v, h = axis * angle, 1e-6
    ahead = lie.so3_log(lie.so3_exp(v) @ lie.so3_exp(h * direction))
    behind = lie.so3_log(lie.so3_exp(v) @ lie.so3_exp(-h * direction))
    np.testing.assert_allclose(
        lie.so3_right_jacobian_inverse(v) @ direction, (ahead - behind) / (2 * h), atol=1e-6, rtol=1e-5
    )


@pytest.mark.parametrize("shape", [(), (1,), (4,), (2, 3)])
def test_poses_survive_rows_and_inverses_in_any_batch_shape(shape):
    rng = np.random.default_rng(0)
    T = lie.transform(lie.so3_exp(rng.normal(size=shape + (3,))), rng.normal(size=shape + (3,)))
    assert T.shape == shape + (4, 4)
    np.testing.assert_allclose(lie.matrix_from_row(lie.row_from_matrix(T)), T, atol=1e-14)
    np.testing.assert_allclose(lie.inverse(T) @ T, np.broadcast_to(np.eye(4), T.shape), atol=1e-14)
    assert lie.is_rigid(T).shape == shape
    assert lie.is_rigid(T).all()


@LAWS
@given(axes, angles, axes, angles)
def test_angle_between_is_a_metric_blind_to_a_common_turn(axis_a, angle_a, axis_b, angle_b):
    R_a, R_b = lie.so3_exp(axis_a * angle_a), lie.so3_exp(axis_b * angle_b)
    d = lie.angle_between(R_a, R_b)
    assert 0 <= d <= np.pi + 1e-12
    np.testing.assert_allclose(lie.angle_between(R_b, R_a), d, atol=1e-7)
    np.testing.assert_allclose(lie.angle_between(R_b @ R_a, R_b @ R_b), d, atol=1e-7)


def test_small_angles_keep_their_digits():
    v = np.array([1e-12, -2e-12, 3e-12])
    np.testing.assert_allclose(lie.so3_log(lie.so3_exp(v)), v, rtol=1e-3)
    assert lie.rotation_angle(np.eye(3)) == 0.0


def test_nan_rows_give_nan_poses_not_errors():
    assert np.isnan(lie.matrix_from_row(np.full(7, np.nan))[:3]).all()
    assert np.isnan(lie.matrix_from_row(np.full((2, 7), np.nan))[:, :3]).all()


def _broken(change):
    T = np.eye(4)
    change(T)
    return T


@pytest.mark.parametrize(
    "T",
    [
        _broken(lambda T: T.__setitem__((0, 0), np.nan)),
        _broken(lambda T: T.__setitem__((0, 3), np.inf)),
        _broken(lambda T: T.__setitem__((2, 2), -1.0)),
        _broken(lambda T: T.__setitem__((0, 0), 1.01)),
        _broken(lambda T: T.__setitem__((3, 0), 0.1)),
        _broken(lambda T: T.__setitem__((3, 3), 2.0)),
        np.zeros((4, 4)),
    ],
    ids=["nan", "infinite", "mirror", "stretched", "projective", "scaled", "zero"],
)
def test_what_is_not_rigid(T):
    assert not lie.is_rigid(T)


@pytest.mark.filterwarnings("error")
def test_entries_whose_squares_overflow_are_no_rotation():
    assert not lie.is_rigid(np.diag([1e308, -1e308, 1e200, 1.0]))
