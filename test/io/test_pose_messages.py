"""Poses, odometry and transforms carry the row and the covariance."""

from __future__ import annotations

import numpy as np
from wire_samples import ROS, STAMP, pose_rows, same_bits, through_dds

from hat_ros.geometry import lie
from hat_ros.io import messages
from hat_ros.types import Motion


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


def test_rotation_of_a_row_is_what_people_see():
    T = lie.transform(lie.so3_exp(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
    message = ROS.pose(STAMP, "cam", lie.row_from_matrix(T))
    assert np.allclose(lie.matrix_from_row(messages.pose_row_from(message.pose)), T, atol=1e-15)
