"""What the stages exchange: validation at the boundary, derived values."""

import dataclasses

import numpy as np
import pytest

from hat_ros.errors import CandidateError, FrameError
from hat_ros.geometry import lie
from hat_ros.types import Camera, Candidates, Detection, Estimate, Frame, Motion, Selection, StateReason, TrackState

K = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])


def _pose(seed):
    rng = np.random.default_rng(seed)
    return lie.transform(lie.so3_exp(rng.normal(size=3)), rng.normal(size=3) + [0, 0, 5])


def _changed(index, value):
    out = K.copy()
    out[index] = value
    return out


@pytest.mark.parametrize(
    ("matrix", "width", "height"),
    [
        (np.eye(4), 640, 480),
        (_changed((0, 0), np.nan), 640, 480),
        (_changed((0, 0), -500), 640, 480),
        (_changed((1, 1), 0), 640, 480),
        (_changed((2, 2), 2), 640, 480),
        (_changed((1, 0), 1), 640, 480),
        (K, 0, 480),
        (K, 640, 100000),
    ],
    ids=["4x4", "nan", "negative fx", "zero fy", "not normalised", "lower triangle", "no width", "absurd height"],
)
def test_camera_rejects_malformed_calibration(matrix, width, height):
    with pytest.raises(FrameError):
        Camera(matrix, width, height)


def test_crop_and_resize_keep_area_preserving_pixel_centres():
    camera = Camera(K, 640, 480)
    points = np.array([[0.1, -0.2, 4.0], [1.0, 0.5, 7.0]])
    crop = camera.crop(100, 60, 200, 120, scale=0.5)
    assert (crop.width, crop.height) == (100, 60)
    expected = (camera.project(points) - [100, 60] + 0.5) * 0.5 - 0.5
    np.testing.assert_allclose(crop.project(points), expected, atol=1e-12)


@pytest.mark.parametrize(
    "rgb", [np.zeros((480, 640), np.uint8), np.zeros((480, 640, 3), np.float32), np.zeros((640, 480, 3), np.uint8)]
)
def test_frame_rejects_an_image_unlike_its_camera(rgb):
    with pytest.raises(FrameError, match="480, 640, 3"):
        Frame(1, rgb, Camera(K, 640, 480))


def test_frame_rejects_a_mask_of_another_size():
    with pytest.raises(FrameError, match="mask"):
        Frame(1, np.zeros((480, 640, 3), np.uint8), Camera(K, 640, 480), np.zeros((10, 10), np.uint8))


def test_detection_box_has_outer_pixel_edges():
    mask = np.zeros((20, 30), bool)
    mask[5:8, 10:14] = True
    detection = Detection(mask)
    np.testing.assert_array_equal(detection.box_xyxy, [9.5, 4.5, 13.5, 7.5])
    assert detection.area_px == 12
    assert not detection.touches_border()
    mask[0, 10] = True
    assert Detection(mask).touches_border()


def test_candidates_are_sorted_best_first_and_ties_keep_their_order():
    T = np.stack([_pose(i) for i in range(4)])
    candidates = Candidates.from_matrices(T, [1.0, 3.0, 1.0, 2.0])
    np.testing.assert_array_equal(candidates.log_score, [3, 2, 1, 1])
    np.testing.assert_allclose(candidates.T_cam_target, T[[1, 3, 0, 2]], atol=1e-14)
    assert np.isnan(candidates.box_xyxy).all()
    assert len(Candidates.none()) == 0
    assert len(Candidates.from_matrices(np.zeros((0, 4, 4)), np.zeros(0))) == 0


def test_candidates_reject_mismatched_shapes():
    with pytest.raises(CandidateError, match=r"\(2, 7\)"):
        Candidates(np.zeros((2, 7)), np.zeros(3))
    with pytest.raises(CandidateError):
        Candidates(np.zeros((2, 6)), np.zeros(2))


def test_no_motion_is_nan_never_identity():
    motion = Motion.none(epoch=3)
    assert not motion.valid
    assert motion.epoch == 3
    assert np.isnan(motion.T_slam_cam[:3]).all()


def test_selection_without_anchor():
    assert Selection.none().anchor is None
    candidates = Candidates.from_matrices(np.stack([_pose(0), _pose(1)]), [0.0, 1.0])
    np.testing.assert_allclose(Selection(candidates, np.zeros(2), np.zeros(2), 1).anchor, _pose(0), atol=1e-14)


def test_only_tracking_and_coasting_have_poses():
    assert [state.has_pose for state in TrackState] == [False, True, True, False, True]
    estimate = Estimate(1, TrackState.LOST, np.full(7, np.nan), np.full((6, 6), np.nan))
    assert np.isnan(estimate.T_cam_target[:3]).all()
    assert estimate.anchor == -1
    with pytest.raises(dataclasses.FrozenInstanceError):
        estimate.stamp_ns = 2


def test_margin_is_the_lead_of_a_basin_over_the_best_other_one():
    turns = np.radians([0.0, 10.0, 90.0, 170.0])
    T = lie.transform(lie.so3_exp(np.outer(turns, [0, 0, 1])), np.tile([0.0, 0, 5], (4, 1)))
    candidates = Candidates(lie.row_from_matrix(T), np.zeros(4))
    path = np.array([0.0, -0.5, -3.0, -4.0])
    selection = Selection(candidates, 2.0 * path, path, 0)
    R = candidates.T_cam_target[:, :3, :3]
    assert selection.margin(R[0], 30.0) == selection.margin(R[1], 30.0) == 3.0
    assert selection.margin(R[2], 30.0) == -3.0
    assert selection.margin(R[0], 175.0) == np.inf
    assert selection.margin(lie.so3_exp(np.array([2.0, 0, 0])), 30.0) == -np.inf
    assert selection.appearance_margin(R[0], 30.0) == 6.0
    assert np.isnan(Selection.none().margin(R[0], 30.0))


def test_lead_of_candidates_is_over_other_basins_that_survive():
    turns = np.radians([0.0, 10.0, 90.0, 170.0])
    T = lie.transform(lie.so3_exp(np.outer(turns, [0, 0, 1])), np.tile([0.0, 0, 5], (4, 1)))
    candidates = Candidates.from_matrices(T, [5.0, 4.5, -np.inf, 2.0])
    assert candidates.lead(30.0) == 3.0
    assert candidates.lead(5.0) == 0.5
    assert candidates.lead(175.0) == np.inf
    assert np.isnan(Candidates.none().lead(30.0))
    assert np.isnan(Candidates.from_matrices(T, [-np.inf] * 4).lead(30.0))


def test_poses_that_were_never_confirmed_are_published_on_request():
    published = {state.name for state in TrackState if state.is_published(False)}
    assert published == {"TRACKING", "COASTING"}
    assert {state.name for state in TrackState if state.is_published(True)} == published | {"INITIALISING"}


def test_every_reason_has_words_of_its_own():
    words = [reason.words for reason in StateReason]
    assert len(set(words)) == len(words) == 10
