"""What the stages say round-trips bit for bit, through rclpy's classes, through CDR and through rosbags' classes."""

from __future__ import annotations

import numpy as np
import pytest
from wire_samples import BAG, ROS, STAMP, candidates, pose_rows, same_bits, through_bag, through_dds

from hat_ros.errors import WireError
from hat_ros.io import messages, topics
from hat_ros.types import Alignment, Candidates, Estimate, Motion, Selection, StateReason, TrackState


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


def rewritten(columns, rows, row, column, value):
    rows = rows.copy()
    rows[row, columns.index(column)] = value
    return ROS.table(STAMP, "cam", columns, rows)


@pytest.mark.parametrize(
    ("column", "value", "complaint"),
    [
        ("rank", 0.5, "whole numbers from 0 on"),
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
        ("state", 5.0, "0 to 4"),
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


def posed(state=TrackState.INITIALISING):
    half = np.random.default_rng(3).normal(size=(6, 6))
    return Estimate(STAMP, state, pose_rows(1)[0], half @ half.T, reason=StateReason.AMBIGUOUS)


def test_status_carries_reason_and_covariance():
    estimate = posed()
    found = messages.status_from(through_dds(ROS.status("cam", estimate, messages.Admitted(0, 0, 0)))).estimate
    assert (found.state, found.reason) == (TrackState.INITIALISING, StateReason.AMBIGUOUS)
    upper = np.triu_indices(6)
    assert same_bits(found.covariance[upper], estimate.covariance[upper])
    assert same_bits(found.covariance, found.covariance.T)


def status_rows():
    message = ROS.status("cam", posed(), messages.Admitted(4, 0, 0))
    return messages.read_table(message, topics.STATUS_COLUMNS)


def test_a_status_of_a_newer_writer_is_read_as_far_as_it_is_known():
    longer = ROS.table(STAMP, "cam", (*topics.STATUS_COLUMNS, "posterior"), np.append(status_rows(), 0.99)[None])
    found = messages.status_from(through_dds(longer))
    assert (found.seq, found.estimate.reason) == (4, StateReason.AMBIGUOUS)


def test_a_status_of_the_first_release_is_read_without_what_came_later():
    n = topics.N_STATUS_AT_FIRST
    shorter = ROS.table(STAMP, "cam", topics.STATUS_COLUMNS[:n], status_rows()[:, :n])
    estimate = messages.status_from(through_dds(shorter)).estimate
    assert estimate.reason == StateReason.UNSTATED
    assert np.isnan(estimate.covariance).all()
    assert np.isfinite(estimate.pose_row).all()


@pytest.mark.parametrize("names", [topics.STATUS_COLUMNS[:16], ("other", *topics.STATUS_COLUMNS[1:])])
def test_a_status_without_the_first_columns_or_with_others_is_refused(names):
    with pytest.raises(WireError, match="table columns must be state seq"):
        messages.status_from(ROS.table(STAMP, "cam", names, status_rows()[:, : len(names)]))
