"""A stage sees complete frames in stamp order, whatever arrives first."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from hat_ros.config import PriorConfig
from hat_ros.errors import RunError
from hat_ros.io import messages, topics
from hat_ros.ros.joined_frames import JoinedFrames
from hat_ros.types import Camera, Estimate, Motion, TrackState

WIRE = messages.Wire.ros()
RGB = np.zeros((6, 8, 3), np.uint8)


def camera(focal):
    return Camera(np.array([[focal, 0, 3.5], [0, focal, 2.5], [0, 0, 1]]), 8, 6)


def admission(stamp, epoch=0):
    return WIRE.admission(stamp, "cam", messages.Admitted(stamp, 0, epoch))


def put_frame(frames, stamp, epoch=0):
    frames.put(topics.ADMISSION, admission(stamp, epoch))
    frames.put(topics.FRAME, WIRE.frame(stamp, "cam", RGB, None))


def taken(frames):
    out = []
    while (joined := frames.take()) is not None:
        out.append(joined)
    return out


def status(stamp, x=0.0):
    estimate = Estimate(stamp, TrackState.TRACKING, np.array([x, 0, 9.0, 0, 0, 0, 1]), np.eye(6))
    return WIRE.status("cam", estimate, messages.Admitted(stamp, 0, 0))


def test_the_order_of_arrival_does_not_matter():
    streams = {
        topics.ADMISSION: [admission(stamp) for stamp in (1, 2, 3)],
        topics.SLAM_STATE: [WIRE.motion(stamp, "cam", Motion.none()) for stamp in (1, 2, 3)],
    }
    for order in set(itertools.permutations([topics.ADMISSION] * 3 + [topics.SLAM_STATE] * 3)):
        frames, out = JoinedFrames((topics.SLAM_STATE,), None, lambda: None), []
        left = {topic: iter(items) for topic, items in streams.items()}
        for topic in order:
            frames.put(topic, next(left[topic]))
            out += taken(frames)
        assert [joined.stamp_ns for joined in out] == [1, 2, 3]
        assert {joined.frame_id for joined in out} == {"cam"}


def test_an_image_waits_for_the_calibration_in_force_at_its_stamp():
    frames = JoinedFrames((topics.FRAME,), None, lambda: None)
    put_frame(frames, 5)
    assert frames.take() is None
    frames.put_camera(WIRE.camera_info(5, "cam", camera(10.0)))
    frames.put_camera(WIRE.camera_info(7, "cam", camera(20.0)))
    for stamp in (6, 7, 8):
        put_frame(frames, stamp)
    focal = [joined.image()[0].camera.K[0, 0] for joined in taken(frames)]
    assert focal == [10.0, 10.0, 20.0, 20.0]


def test_a_frame_waits_for_the_fused_poses_that_its_prior_needs():
    frames = JoinedFrames((topics.FRAME,), PriorConfig(enabled=True, delay_frames=2), lambda: None)
    frames.put_camera(WIRE.camera_info(1, "cam", camera(10.0)))
    for stamp in (1, 2, 3):
        put_frame(frames, stamp)
    assert [joined.prior for joined in taken(frames)] == [None, None]
    frames.put_status(status(1, x=0.5))
    (third,) = taken(frames)
    assert third.prior is not None
    assert third.prior.pose_row[0] == 0.5


def test_a_new_epoch_resets_once_and_gives_up_what_is_incomplete():
    resets = []
    frames = JoinedFrames((topics.FRAME,), PriorConfig(enabled=False), lambda: resets.append(1))
    frames.put_camera(WIRE.camera_info(1, "cam", camera(10.0)))
    put_frame(frames, 1)
    frames.put(topics.ADMISSION, admission(2))
    put_frame(frames, 3, epoch=1)
    put_frame(frames, 4, epoch=1)
    assert [joined.stamp_ns for joined in taken(frames)] == [1, 3, 4]
    assert resets == [1], "the first epoch finds the stage fresh"
    frames.put(topics.FRAME, WIRE.frame(2, "cam", RGB, None))
    assert (frames.late, len(frames)) == (1, 0)


@pytest.mark.parametrize("image_first", [False, True])
def test_after_a_step_back_the_same_stamps_come_again(image_first):
    resets = []
    frames, out = JoinedFrames((topics.FRAME,), PriorConfig(enabled=True, delay_frames=2), lambda: resets.append(1)), []
    for epoch, focal in ((0, 10.0), (1, 20.0), (2, 30.0)):
        frames.put_camera(WIRE.camera_info(5 - epoch, "cam", camera(focal)))
        for stamp in range(5 - epoch, 10):
            parts = [
                (topics.ADMISSION, admission(stamp, epoch)),
                (topics.FRAME, WIRE.frame(stamp, "cam", RGB + epoch, None)),
            ]
            for topic, message in reversed(parts) if image_first else parts:
                frames.put(topic, message)
            (joined,) = taken(frames)
            frames.put_status(status(stamp, x=epoch + 0.01 * stamp))
            image = joined.image()[0]
            out.append((joined.stamp_ns, image.rgb.max(), image.camera.K[0, 0]))
            if joined.prior is not None:
                assert epoch < joined.prior.pose_row[0] < epoch + 0.5, "of this epoch alone"
        assert joined.prior is not None
        assert resets == [1] * epoch
    assert out == [(stamp, e, 10.0 + 10 * e) for e in range(3) for stamp in range(5 - e, 10)]
    assert (frames.late, len(frames)) == (0, 0)


def test_stamps_of_a_restarted_entrance_step_back_within_its_first_epoch():
    resets = []
    frames = JoinedFrames((topics.FRAME,), None, lambda: resets.append(1))
    frames.put_camera(WIRE.camera_info(3, "cam", camera(10.0)))
    for stamp in (5, 6, 3, 4):
        put_frame(frames, stamp)
        assert [joined.stamp_ns for joined in taken(frames)] == [stamp]
    assert resets == [1]


def test_a_lost_message_is_an_error_and_a_missing_one_is_named():
    frames = JoinedFrames((topics.SLAM_STATE,), None, lambda: None)
    frames.put(topics.ADMISSION, admission(1))
    assert frames.missing() == (1, (topics.SLAM_STATE,))
    frames.put(topics.ADMISSION, admission(2))
    frames.put(topics.SLAM_STATE, WIRE.motion(2, "cam", Motion.none()))
    frames._epoch = 0  # an earlier frame has been processed
    with pytest.raises(RunError, match="frame 1 never had /hat/slam_state"):
        frames.take()


def test_live_a_frame_that_lacks_a_message_is_passed_over():
    frames = JoinedFrames((topics.FRAME,), PriorConfig(enabled=True, delay_frames=1), lambda: None, live=True)
    frames.put_camera(WIRE.camera_info(1, "cam", camera(10.0)))
    put_frame(frames, 1)
    frames.put(topics.ADMISSION, admission(2))
    assert [joined.stamp_ns for joined in taken(frames)] == [1]
    frames.put_status(status(1, x=0.5))
    put_frame(frames, 3)
    put_frame(frames, 4)
    third, fourth = taken(frames)
    assert [third.stamp_ns, fourth.stamp_ns] == [3, 4]
    assert third.prior.pose_row[0] == fourth.prior.pose_row[0] == 0.5, "frame 3 has no estimate: it is not waited for"
    assert (frames.lost, len(frames)) == (1, 0)
    frames.put(topics.FRAME, WIRE.frame(2, "cam", RGB, None))
    assert (frames.late, frames.take()) == (1, None)


def test_a_stage_without_images_has_none():
    frames = JoinedFrames((topics.SLAM_STATE,), None, lambda: None)
    frames.put(topics.ADMISSION, admission(1))
    frames.put(topics.SLAM_STATE, WIRE.motion(1, "cam", Motion.none()))
    with pytest.raises(RunError, match="not joined"):
        frames.take().image()


def given(stamp):
    row = np.array([0.1, 0.2, 5.0, 0, 0, 0, 1])
    return WIRE.pose_with_covariance(stamp, "cam", row, np.eye(6) * stamp)


@pytest.mark.parametrize("live", [False, True])
def test_a_frame_waits_for_the_initial_pose_that_its_admission_promises(live):
    frames = JoinedFrames((), None, lambda: None, live, takes_given=True)
    for stamp, promised in ((1, 0), (2, 1), (3, 0)):
        if stamp == 3 and not live:
            frames.put_given(given(2))
        frames.put(topics.ADMISSION, WIRE.admission(stamp, "cam", messages.Admitted(stamp, 0, 0, 0, promised)))
    joined = [frames.take() for _ in range(4)]
    found = [(frame.stamp_ns, frame.given) for frame in joined if frame is not None]
    if live:  # lost for a frame that has been given up: the next one does not wait for it
        assert found == [(1, None), (2, None), (3, None)]
        return
    assert [stamp for stamp, _ in found] == [1, 2, 3]
    assert [pose is not None for _, pose in found] == [False, True, False]
    assert np.array_equal(found[1][1].covariance, 2 * np.eye(6))


def test_nothing_is_handed_out_before_the_initial_pose_has_come():
    frames = JoinedFrames((), None, lambda: None, True, takes_given=True)
    frames.put(topics.ADMISSION, WIRE.admission(1, "cam", messages.Admitted(1, 0, 0, 0, 1)))
    assert frames.take() is None
    frames.put_given(given(1))
    assert frames.take().given is not None
