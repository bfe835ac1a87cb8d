"""Every message round-trips byte for byte, through rclpy's classes, through CDR and through rosbags' classes."""

from __future__ import annotations

import array

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from hat_ros.errors import FrameError, WireError
from hat_ros.geometry import lie
from hat_ros.io import images, messages, topics
from hat_ros.io.bag import TYPESTORE
from hat_ros.types import Alignment, Camera, Candidates, Detection, Estimate, Motion, Selection, TrackState

STAMP = 1_700_000_000_123_456_789
ROS = messages.Wire.ros()
BAG = messages.Wire.bag(TYPESTORE)


def through_dds(message):
    """What a subscriber in another process gets."""
    return deserialize_message(serialize_message(message), type(message))


def through_bag(message):
    kind = message.__msgtype__
    return TYPESTORE.deserialize_cdr(bytes(TYPESTORE.serialize_cdr(message, kind)), kind)


def pose_rows(n, seed=0):
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(n, 4))
    return np.column_stack([rng.normal(size=(n, 3)), quat / np.linalg.norm(quat, axis=1, keepdims=True)])


def candidates(n=4, seed=0):
    rng = np.random.default_rng(seed)
    score = -np.sort(rng.normal(size=n))
    return Candidates(pose_rows(n, seed), score, np.array([1.5, 2.5, 30.25, 40.125]))


def same_bits(a, b):
    return np.asarray(a, dtype=np.float64).tobytes() == np.asarray(b, dtype=np.float64).tobytes()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("make", "carry"), [(ROS, through_dds), (BAG, through_bag)])
def test_all_tables_keep_every_bit(make, carry, seed):
    found = messages.candidates_from(carry(make.candidates(STAMP, "cam", candidates(seed=seed))))
    expected = candidates(seed=seed)
    assert same_bits(found.pose_rows, expected.pose_rows)
    assert same_bits(found.log_score, expected.log_score)
    assert same_bits(found.box_xyxy, expected.box_xyxy)

    selection = Selection(expected, np.arange(4) * 0.1, -np.arange(4) / 3, 2)
    again = messages.selection_from(carry(make.selection(STAMP, "cam", selection)))
    assert same_bits(again.scaled_score, selection.scaled_score)
    assert same_bits(again.path_score, selection.path_score)
    assert again.selected == 2

    motion = Motion(True, 3, pose_rows(1, seed)[0], 17, 0.01)
    moved = messages.motion_from(carry(make.motion(STAMP, "cam", motion)))
    assert same_bits(moved.pose_row, motion.pose_row)
    assert (moved.valid, moved.epoch, moved.n_keyframes) == (True, 3, 17)

    alignment = Alignment(5, 0.123456789, pose_rows(1, seed)[0][3:], np.array([1.0, 2.0, 1 / 3]), 9, 0.07, 3)
    aligned = messages.alignment_from(carry(make.alignment(STAMP, "slam_3", alignment)))
    assert same_bits(aligned.quat_xyzw, alignment.quat_xyzw)
    assert same_bits(aligned.translation_m, alignment.translation_m)
    assert (aligned.version, aligned.scale, aligned.n_anchors, aligned.rms, aligned.epoch) == (
        5,
        0.123456789,
        9,
        0.07,
        3,
    )

    row = pose_rows(1, seed)[0]
    estimate = Estimate(
        STAMP, TrackState.COASTING, row, np.eye(6), True, 4, 2, 0.05, alignment, slam_epoch=3, gap_frames=7
    )
    status = messages.status_from(carry(make.status("cam", estimate, messages.Admitted(41, 6, 0))))
    assert same_bits(status.estimate.pose_row, row)
    assert (status.seq, status.dropped_total, status.alignment_version) == (41, 6, 5)
    assert (status.estimate.stamp_ns, status.estimate.state) == (STAMP, TrackState.COASTING)
    assert (status.estimate.keyframe, status.estimate.n_candidates, status.estimate.anchor) == (True, 4, 2)
    assert (status.estimate.gate_weight, status.estimate.slam_epoch, status.estimate.gap_frames) == (0.05, 3, 7)


@given(stamp=st.integers(0, 2**31 * 10**9 - 1))
@settings(max_examples=50, deadline=None)
def test_stamps_survive_to_the_nanosecond(stamp):
    assert messages.stamp_of(through_dds(ROS.pose(stamp, "cam", pose_rows(1)[0]))) == stamp


def test_stamp_beyond_ros_time_is_refused():
    with pytest.raises(FrameError, match="does not fit"):
        ROS.header(2**31 * 10**9, "cam")


def test_empty_tables_keep_their_fields():
    message = through_dds(ROS.candidates(STAMP, "cam", Candidates.none()))
    assert [field.name for field in message.fields] == list(topics.CANDIDATE_COLUMNS)
    assert len(messages.candidates_from(message)) == 0
    assert messages.selection_from(through_dds(ROS.selection(STAMP, "cam", Selection.none()))).selected == -1


def test_no_motion_and_no_pose_travel_as_nan():
    motion = messages.motion_from(through_dds(ROS.motion(STAMP, "cam", Motion.none(2))))
    assert not motion.valid
    assert np.isnan(motion.pose_row).all()
    lost = Estimate(STAMP, TrackState.LOST, np.full(7, np.nan), np.full((6, 6), np.nan))
    assert np.isnan(
        messages.status_from(through_dds(ROS.status("cam", lost, messages.Admitted(0, 0, 0)))).estimate.pose_row
    ).all()


def test_dropped_candidates_keep_their_slot():
    rows, score = pose_rows(3), np.array([0.5, 0.25, -np.inf])
    rows[2] = np.nan
    found = messages.candidates_from(through_dds(ROS.candidates(STAMP, "cam", Candidates(rows, score))))
    assert same_bits(found.pose_rows, rows)
    assert same_bits(found.log_score, score)


def test_both_families_of_classes_serialize_to_the_same_bytes():
    for name, args in (("candidates", (STAMP, "cam", candidates())), ("pose", (STAMP, "cam", pose_rows(1)[0]))):
        ours = getattr(BAG, name)(*args)
        bag_bytes = bytes(TYPESTORE.serialize_cdr(ours, ours.__msgtype__))
        assert bag_bytes == serialize_message(getattr(ROS, name)(*args))[: len(bag_bytes)]


# ------------------------------------------------------------------ rejection


def broken(change):
    message = through_dds(ROS.candidates(STAMP, "cam", candidates()))
    change(message)
    return message


def swap_names(message):
    message.fields[0].name, message.fields[1].name = "y", "x"


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (swap_names, "columns must be x y z"),
        (lambda m: m.fields.pop(), "columns must be"),
        (lambda m: setattr(m.fields[3], "datatype", 7), "column 'qx' must be one FLOAT64"),
        (lambda m: setattr(m.fields[3], "offset", 25), "offset 24"),
        (lambda m: setattr(m.fields[3], "count", 2), "count 2"),
        (lambda m: setattr(m, "is_bigendian", True), "little-endian"),
        (lambda m: setattr(m, "height", 2), "height 1"),
        (lambda m: setattr(m, "point_step", 96), "point_step 104"),
        (lambda m: setattr(m, "row_step", 0), "row_step 416"),
        (lambda m: setattr(m, "data", m.data[:-1]), "must hold 416 bytes, found 415"),
        (lambda m: setattr(m, "width", 3), "row_step 312"),
    ],
)
def test_tables_that_are_off_are_rejected(change, complaint):
    with pytest.raises(WireError, match=complaint):
        messages.candidates_from(broken(change))


def rewritten(columns, rows, row, column, value):
    rows = rows.copy()
    rows[row, columns.index(column)] = value
    return ROS.table(STAMP, "cam", columns, rows)


@pytest.mark.parametrize(
    ("column", "value", "complaint"),
    [
        ("rank", 5.0, "must count from 0"),
        ("score", np.nan, "number or -inf"),
        ("score", np.inf, "number or -inf"),
        ("bx0", 7.0, "same in all rows"),
        ("qw", 2.0, "unit quaternion"),
        ("z", np.nan, "must be finite"),
    ],
)
def test_candidate_values_that_make_no_sense_are_rejected(column, value, complaint):
    rows = messages.read_table(ROS.candidates(STAMP, "cam", candidates()), topics.CANDIDATE_COLUMNS)
    with pytest.raises(WireError, match=complaint):
        messages.candidates_from(rewritten(topics.CANDIDATE_COLUMNS, rows, 1, column, value))


@pytest.mark.parametrize(
    ("column", "value", "complaint"),
    [
        ("state", 4.0, "0 to 3"),
        ("state", 1.5, "whole number"),
        ("seq", -1.0, "whole number"),
        ("keyframe", 2.0, "0 or 1"),
        ("anchor", -2.0, "whole number"),
        ("dropped_total", np.nan, "whole number"),
        ("qx", 9.0, "unit quaternion"),
    ],
)
def test_status_values_that_make_no_sense_are_rejected(column, value, complaint):
    estimate = Estimate(STAMP, TrackState.TRACKING, pose_rows(1)[0], np.eye(6))
    rows = messages.read_table(ROS.status("cam", estimate, messages.Admitted(0, 0, 0)), topics.STATUS_COLUMNS)
    with pytest.raises(WireError, match=complaint):
        messages.status_from(rewritten(topics.STATUS_COLUMNS, rows, 0, column, value))


def test_two_selected_rows_are_rejected():
    message = ROS.selection(STAMP, "cam", Selection(candidates(), np.zeros(4), np.zeros(4), 1))
    rows = messages.read_table(message, topics.SELECTION_COLUMNS)
    with pytest.raises(WireError, match="at most one 1"):
        messages.selection_from(rewritten(topics.SELECTION_COLUMNS, rows, 3, "selected", 1.0))


def test_a_single_row_table_with_two_rows_is_rejected():
    message = ROS.table(STAMP, "cam", topics.ADMISSION_COLUMNS, np.zeros((2, 3)))
    with pytest.raises(WireError, match="one row, found 2"):
        messages.admitted_from(message)


# ------------------------------------------------------------------ poses and images


def test_pose_messages_carry_the_row_and_the_covariance():
    row, covariance = pose_rows(1)[0], np.arange(36.0).reshape(6, 6)
    message = through_dds(ROS.pose_with_covariance(STAMP, "cam", row, covariance))
    assert same_bits(messages.pose_row_from(message.pose.pose), row)
    assert same_bits(message.pose.covariance, covariance)
    assert message.header.frame_id == "cam"
    transform = through_dds(ROS.transform(STAMP, "cam", "target", row))
    assert transform.child_frame_id == "target"
    assert transform.transform.rotation.w == row[6]
    array_message = through_dds(ROS.pose_array(STAMP, "cam", pose_rows(3)))
    assert [messages.pose_row_from(pose).tolist() for pose in array_message.poses] == pose_rows(3).tolist()


def test_odometry_names_its_epoch_and_admits_what_it_does_not_know():
    known = ROS.odometry(STAMP, "cam", Motion(True, 4, pose_rows(1)[0], 3, 0.02))
    assert (known.header.frame_id, known.child_frame_id) == ("slam_4", "cam")
    assert np.isclose(known.pose.covariance[35], 0.02**2)
    assert ROS.odometry(STAMP, "cam", Motion(True, 0, pose_rows(1)[0])).pose.covariance[0] == -1.0


def test_integers_become_floats_before_they_reach_a_field():
    message = ROS.pose(STAMP, "cam", np.array([1, 2, 3, 0, 0, 0, 1]))
    assert through_dds(message).pose.position.x == 1.0


@pytest.mark.parametrize("silhouette", [True, False])
def test_frame_carries_image_and_mask(silhouette):
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
    mask = np.zeros((24, 32), dtype=bool)
    mask[5:9, 3:20] = True
    message = ROS.frame(STAMP, "cam", rgb, Detection(mask, silhouette))
    assert isinstance(message.data, array.array)
    found, detection = messages.frame_from(through_dds(message))
    assert np.array_equal(found, rgb)
    assert np.array_equal(detection.mask, mask)
    assert detection.silhouette is silhouette
    assert messages.frame_from(ROS.frame(STAMP, "cam", rgb, None))[1] is None


def test_frame_with_another_encoding_or_alpha_is_rejected():
    rgba = np.zeros((4, 4, 4), dtype=np.uint8)
    rgba[0, 0, 3] = 7
    with pytest.raises(WireError, match="alpha must be 0 and either 128"):
        messages.frame_from(ROS.image(STAMP, "cam", "rgba8", rgba))
    rgba[0, 0, 3], rgba[1, 1, 3] = 128, 255
    with pytest.raises(WireError, match="alpha"):
        messages.frame_from(ROS.image(STAMP, "cam", "rgba8", rgba))
    with pytest.raises(WireError, match="rgba8"):
        messages.frame_from(ROS.image(STAMP, "cam", "bgra8", rgba))


def test_camera_info_round_trips_and_refuses_what_a_pinhole_is_not():
    camera = Camera(np.array([[500.5, 0.25, 160.1], [0, 501.5, 120.2], [0, 0, 1.0]]), 320, 240)
    for make, carry in ((ROS, through_dds), (BAG, through_bag)):
        assert messages.same_camera(messages.camera_from(carry(make.camera_info(STAMP, "cam", camera))), camera)
    message = ROS.camera_info(STAMP, "cam", camera)
    message.d = [0.1, 0.0, 0.0, 0.0, 0.0]
    with pytest.raises(FrameError, match="rectify first"):
        messages.camera_from(message)
    message = ROS.camera_info(STAMP, "cam", camera)
    message.binning_x = 2
    with pytest.raises(FrameError, match="binning"):
        messages.camera_from(message)
    message = ROS.camera_info(STAMP, "cam", camera)
    message.k[0] = np.nan
    with pytest.raises(FrameError, match="finite"):
        messages.camera_from(message)


def test_rotation_of_a_row_is_what_people_see():
    T = lie.transform(lie.so3_exp(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
    message = ROS.pose(STAMP, "cam", lie.row_from_matrix(T))
    assert np.allclose(lie.matrix_from_row(messages.pose_row_from(message.pose)), T, atol=1e-15)


def test_diagnostics_have_text_level_and_figures():
    message = through_dds(ROS.diagnostics(STAMP, "hat: slam", 2, "bad", {"answered": 3}))
    status = message.status[0]
    assert (status.name, status.level, status.message) == ("hat: slam", b"\x02", "bad")
    assert [(item.key, item.value) for item in status.values] == [("answered", "3")]


def test_images_module_and_wire_agree_on_mask_values():
    assert (images.SILHOUETTE, images.BOX) == (255, 128)
