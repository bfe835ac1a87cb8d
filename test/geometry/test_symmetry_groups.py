"""Groups of motions, and the nearest of equal poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import (
    FREE_VARIANCE_RAD2,
    Symmetry,
    about_center,
    declaration_of,
    known_up_to,
    symmetry_from_declaration,
    symmetry_of_turns,
)

NO_AXES = np.zeros((0, 3))
CENTER = np.array([0.2, -0.1, 0.4])
Z = np.array([0.0, 0, 1])
HALF_X = [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]


def turns_of(group):
    return about_center(Rotation.create_group(group).as_matrix(), CENTER)


def random_poses(seed, n=50):
    rng = np.random.default_rng(seed)
    return lie.transform(lie.matrix_from_quat(rng.normal(size=(n, 4))), rng.normal(size=(n, 3)) + [0, 0, 5])


@pytest.mark.parametrize(("group", "order"), [("C4", 4), ("D2", 4), ("D6", 12), ("T", 12), ("O", 24), ("I", 60)])
def test_a_few_turns_generate_their_group(group, order):
    every = turns_of(group)
    rng = np.random.default_rng(1)
    found = {symmetry_of_turns(rng.permutation(every)[:6], NO_AXES, CENTER).order for _ in range(8)}
    assert max(found) == order
    assert all(order % size == 0 for size in found), "subgroups"
    assert symmetry_of_turns(every, NO_AXES, CENTER).order == order


@pytest.mark.parametrize("group", ["C4", "D2", "O"])
def test_all_equal_poses_are_one_nearest_to_a_reference(group):
    symmetry = Symmetry(turns_of(group))
    T, reference = random_poses(2), random_poses(3)[:, :3, :3]
    nearest = symmetry.nearest(T, reference)
    for turn in symmetry.turns:
        np.testing.assert_allclose(symmetry.nearest(T @ turn, reference), nearest, atol=1e-9)
    every = lie.angle_between((T[:, None] @ symmetry.turns)[..., :3, :3], reference[:, None])
    np.testing.assert_allclose(lie.angle_between(nearest[:, :3, :3], reference), every.min(axis=1), atol=1e-7)
    np.testing.assert_allclose(nearest[:, :3, :3] @ CENTER + nearest[:, :3, 3], T[:, :3, :3] @ CENTER + T[:, :3, 3])


@pytest.mark.parametrize("flips", [False, True])
def test_about_a_free_axis_no_other_turn_is_nearer(flips):
    turns = np.array([lie.transform(np.diag([1.0, -1, -1]), CENTER * [0, 2, 2])]) if flips else np.zeros((0, 4, 4))
    symmetry = symmetry_of_turns(turns, Z[None], CENTER)
    assert (symmetry.order, len(symmetry.axes)) == (1 + flips, 1)
    T, reference = random_poses(4), random_poses(5)[:, :3, :3]
    apart = lie.angle_between(symmetry.nearest(T, reference)[:, :3, :3], reference)
    sampled = T[:, None] @ symmetry.sampled()
    best = lie.angle_between(sampled[..., :3, :3], reference[:, None]).min(axis=1)
    assert (apart <= best + 1e-9).all()
    assert (apart >= best - 0.02).all(), "it is one of the equal ones"


def test_a_ball_takes_any_rotation_and_keeps_its_middle():
    symmetry = symmetry_of_turns(np.zeros((0, 4, 4)), np.array([Z, [1.0, 1, 0]]), CENTER)
    T, reference = random_poses(6), random_poses(7)[:, :3, :3]
    nearest = symmetry.nearest(T, reference)
    np.testing.assert_array_equal(nearest[:, :3, :3], reference)
    np.testing.assert_allclose(nearest[:, :3, :3] @ CENTER + nearest[:, :3, 3], T[:, :3, :3] @ CENTER + T[:, :3, 3])
    with pytest.raises(ValueError, match="cannot be listed"):
        symmetry.sampled()


def test_without_a_symmetry_nothing_is_touched():
    T = random_poses(8)
    assert Symmetry().nearest(T, T[0, :3, :3]) is T
    assert not Symmetry().free_covariance(T[0]).any()


def test_a_full_turn_about_the_free_axis_is_covered_by_the_covariance_and_nothing_else_is():
    symmetry, T = Symmetry(axes=Z[None], center_m=CENTER), random_poses(9)[0]
    covariance = symmetry.free_covariance(T)
    assert np.linalg.matrix_rank(covariance) == 1
    axis = T[:3, :3] @ Z
    assert axis @ covariance[3:, 3:] @ axis == pytest.approx(FREE_VARIANCE_RAD2)
    small = lie.so3_exp(1e-6 * Z)
    moved = T @ lie.transform(small, CENTER - small @ CENTER)
    shift = np.concatenate([moved[:3, 3] - T[:3, 3], lie.so3_log(moved[:3, :3] @ T[:3, :3].T)]) / 1e-6
    np.testing.assert_allclose(np.outer(shift, shift) * FREE_VARIANCE_RAD2, covariance, atol=1e-4)


def test_a_declaration_is_read_in_its_unit_and_written_in_metres():
    moved = [-1, 0, 0, 200, 0, -1, 0, 100, 0, 0, 1, 0, 0, 0, 0, 1]
    symmetry = symmetry_from_declaration([moved], [], 1e-3)
    np.testing.assert_allclose(symmetry.turns[1][:3, 3], [0.2, 0.1, 0])
    again = symmetry_from_declaration(*declaration_of(symmetry).values(), unit_m=1.0)
    np.testing.assert_allclose(again.turns, symmetry.turns)
    free = symmetry_from_declaration([HALF_X], [{"axis": [0, 0, 2], "offset": [10, 20, 0]}], 1e-3)
    np.testing.assert_allclose(free.center_m, [0.01, 0.02, 0])
    assert declaration_of(free)["symmetries_continuous"] == [{"axis": [0.0, 0.0, 1.0], "offset": [0.01, 0.02, 0.0]}]


@pytest.mark.parametrize(
    ("discrete", "continuous", "complaint"),
    [
        ("all", [], "symmetries_discrete must be a list, found 'all'"),
        ([[1, 2]], [], r"symmetries_discrete\[0\] must be 16 finite numbers"),
        ([[2.0, *HALF_X[1:]]], [], r"symmetries_discrete\[0\] is no rigid motion"),
        ([[float("nan"), *HALF_X[1:]]], [], "16 finite numbers"),
        ([], [{"axis": [0, 0, 0], "offset": [0, 0, 0]}], "axis must not be zero"),
        ([], [{"axis": [0, 0, 1]}], "must have 'axis' and 'offset'"),
        ([], [{"axis": ["x", 0, 1], "offset": [0, 0, 0]}], "axis must be 3 finite numbers"),
        ([lie.transform(lie.so3_exp(0.037 * Z), np.zeros(3)).ravel().tolist()], [], "more than 120 different turns"),
    ],
)
def test_what_declares_no_symmetry_is_one_sentence(discrete, continuous, complaint):
    with pytest.raises(ValueError, match=complaint):
        symmetry_from_declaration(discrete, continuous, 1.0)


def test_what_is_known_of_a_pose_in_words():
    assert known_up_to(1, 0) == ""
    assert known_up_to(24, 0) == "known up to 24 equal orientations"
    assert known_up_to(1, 1) == "known up to a turn about its axis"
    assert known_up_to(2, 1).endswith("and which end is which")
    assert known_up_to(1, 3) == "known up to any turn"
