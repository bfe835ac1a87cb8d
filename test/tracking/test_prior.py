"""Priors: only the distant past, whatever has arrived; constant rate; robust; bounded."""

from dataclasses import replace

import numpy as np
import pytest

from hat_ros.config import PriorConfig
from hat_ros.geometry import lie
from hat_ros.tracking.prior import HISTORY_FRAMES, PriorBuffer, extrapolate
from hat_ros.types import Estimate, TrackState

CONFIG = PriorConfig(enabled=True, delay_frames=4)
STEP_NS = 100_000_000
AXIS = np.array([0.2, 1.0, -0.1])


def _stamp(i):
    return 5_000_000_000 + i * STEP_NS


def _truth(i, rate_deg=2.0):
    R = lie.so3_exp(np.radians(rate_deg) * i * AXIS) @ lie.so3_exp(np.array([0.3, 0.2, 2.9]))
    return lie.transform(R, np.array([0.1 * i, -0.02 * i, 8 - 0.05 * i]))


def _estimate(i, state=TrackState.TRACKING, T=None):
    row = lie.row_from_matrix(_truth(i) if T is None else T) if state.has_pose else np.full(7, np.nan)
    return Estimate(_stamp(i), state, row, np.full((6, 6), np.nan))


def _filled(n, **replaced):
    buffer = PriorBuffer(CONFIG)
    for i in range(n):
        buffer.admit(_stamp(i))
        buffer.push(replaced.get(f"at_{i}", _estimate(i)))
    return buffer


def test_disabled_there_is_never_a_prior_and_everything_is_ready():
    buffer = PriorBuffer(PriorConfig(enabled=False))
    for i in range(10):
        assert buffer.before(_stamp(i)) is None
        assert buffer.ready(_stamp(i))
        buffer.push(_estimate(i))


def test_constant_motion_is_extrapolated_exactly():
    prior = _filled(20).before(_stamp(20))
    assert prior.stamp_ns == _stamp(16)
    assert prior.healthy
    np.testing.assert_allclose(prior.T_cam_target, _truth(20), atol=1e-9)
    np.testing.assert_array_equal(prior.fused_row, _estimate(16).pose_row)


def test_the_first_frames_have_none_and_one_pose_is_held():
    buffer = PriorBuffer(CONFIG)
    for i in range(4):
        assert buffer.before(_stamp(i)) is None
        buffer.push(_estimate(i))
    np.testing.assert_allclose(buffer.before(_stamp(4)).T_cam_target, _truth(0), atol=1e-12)


@pytest.mark.parametrize("known", [16, 17, 19])
def test_what_arrived_later_than_the_delay_is_never_used(known):
    """The estimates of frames 17 to 19 may or may not be there already."""
    buffer = PriorBuffer(CONFIG)
    for i in range(20):
        buffer.admit(_stamp(i))
    for i in range(known + 1):
        buffer.push(_estimate(i))
    assert buffer.ready(_stamp(20))
    late = buffer.before(_stamp(20))
    wild = PriorBuffer(CONFIG)
    for i in range(20):
        wild.admit(_stamp(i))
        wild.push(_estimate(i) if i <= 16 else _estimate(i, T=lie.transform(np.eye(3), np.array([9.0, 9, 9]))))
    assert late.pose_row.tobytes() == wild.before(_stamp(20)).pose_row.tobytes()


def test_frames_admitted_ahead_do_not_change_the_answer():
    buffer, ahead = _filled(20), _filled(20)
    for i in range(20, 40):
        ahead.admit(_stamp(i))
    assert buffer.before(_stamp(20)).pose_row.tobytes() == ahead.before(_stamp(20)).pose_row.tobytes()


def test_ready_waits_for_the_estimates_it_needs():
    buffer = PriorBuffer(CONFIG)
    for i in range(8):
        buffer.admit(_stamp(i))
    assert buffer.ready(_stamp(3))
    assert not buffer.ready(_stamp(7))
    for i in (0, 1, 3):
        buffer.push(_estimate(i))
    assert not buffer.ready(_stamp(7))
    buffer.push(_estimate(2))
    assert buffer.ready(_stamp(7))


@pytest.mark.parametrize("state", [TrackState.UNINITIALISED, TrackState.LOST])
def test_without_a_pose_at_the_delayed_frame_there_is_no_prior(state):
    assert _filled(20, at_16=_estimate(16, state)).before(_stamp(20)) is None


def test_a_coasting_pose_is_a_prior_but_not_a_healthy_one():
    prior = _filled(20, at_16=_estimate(16, TrackState.COASTING)).before(_stamp(20))
    assert not prior.healthy
    assert prior.supported


def test_a_pose_that_no_image_spoke_for_supports_nothing():
    held = replace(_estimate(16, TrackState.COASTING), gap_frames=2)
    assert not _filled(20, at_16=held).before(_stamp(20)).supported


def test_a_gap_or_a_jump_ends_the_history():
    gap = _filled(20, at_14=_estimate(14, TrackState.LOST)).before(_stamp(20))
    np.testing.assert_allclose(gap.T_cam_target, _truth(20), atol=1e-9)
    flipped = {f"at_{i}": _estimate(i, T=_truth(i) @ _half_turn()) for i in range(14)}
    np.testing.assert_allclose(_filled(20, **flipped).before(_stamp(20)).T_cam_target, _truth(20), atol=1e-9)


def _half_turn():
    return lie.transform(lie.so3_exp(np.array([0, np.pi, 0])), np.zeros(3))


def test_one_bad_pose_hardly_moves_the_answer():
    bad = _truth(13).copy()
    bad[:3, :3] = lie.so3_exp(np.array([0.2, 0, 0])) @ bad[:3, :3]
    bad[:3, 3] += 1.0
    prior = _filled(20, at_13=_estimate(13, T=bad)).before(_stamp(20))
    assert np.degrees(lie.angle_between(prior.T_cam_target[:3, :3], _truth(20)[:3, :3])) < 1.0
    assert np.linalg.norm(prior.T_cam_target[:3, 3] - _truth(20)[:3, 3]) < 0.1


def test_extrapolation_goes_by_stamps_not_by_count():
    stamps = np.array([_stamp(0), _stamp(1), _stamp(4), _stamp(5)])
    poses = np.stack([_truth(i) for i in (0, 1, 4, 5)])
    row = extrapolate(stamps, poses, _stamp(9))
    np.testing.assert_allclose(lie.matrix_from_row(row), _truth(9), atol=1e-9)


def test_memory_is_bounded_and_unknown_stamps_are_ignored():
    buffer = PriorBuffer(CONFIG)
    buffer.push(_estimate(3))
    for i in range(300):
        buffer.before(_stamp(i))
        buffer.push(_estimate(i))
    assert len(buffer._frames) <= CONFIG.delay_frames + HISTORY_FRAMES + 64


def test_reset_forgets():
    buffer = _filled(20)
    buffer.reset()
    assert buffer.before(_stamp(20)) is None


def test_frames_that_were_given_up_are_as_if_they_had_never_entered():
    def asked(lost):
        buffer = PriorBuffer(CONFIG)
        for i in range(14):
            if i not in lost:
                buffer.admit(_stamp(i))
                buffer.push(_estimate(i))
        return buffer

    with_holes, without = asked(()), asked((4, 7, 8, 9))
    for i in (4, 7, 8, 9):
        with_holes._frames[_stamp(i)] = None
    for buffer in (with_holes, without):
        buffer.admit(_stamp(14))
        buffer.drop_unanswered(_stamp(14))
        assert buffer.ready(_stamp(14))
    found, expected = (buffer.before(_stamp(14)) for buffer in (with_holes, without))
    assert found.stamp_ns == expected.stamp_ns
    assert found.pose_row.tobytes() == expected.pose_row.tobytes()
