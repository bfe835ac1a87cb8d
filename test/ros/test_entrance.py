"""What may enter, what is refused, and that every image is accounted for."""

from __future__ import annotations

import numpy as np
import pytest

from hat_ros.core.sync import Admission
from hat_ros.errors import FrameError
from hat_ros.io import messages
from hat_ros.io.calibration import Calibration
from hat_ros.ros.entrance import Entrance
from hat_ros.types import Camera

CAMERA = Camera(np.array([[10.0, 0, 3.5], [0, 10, 2.5], [0, 0, 1]]), 8, 6)
WIRE = messages.Wire.ros()


def image(stamp, size=(6, 8), encoding="rgb8"):
    return WIRE.image(stamp, "cam", encoding, np.zeros((*size, 3), np.uint8))


def mask(stamp, empty=False):
    return WIRE.image(stamp, "cam", "mono8", np.zeros((0, 0) if empty else (6, 8), np.uint8))


def entrance(live=False, with_masks=False):
    out = Entrance(live, with_masks)
    out.set_calibration(Calibration(CAMERA))
    return out


def enter(waiting, admission):
    found = waiting.next_frame(admission)
    return None if found is None else admission.admit(found[0].stamp_ns)


def test_images_wait_for_the_calibration_and_then_enter_in_order():
    waiting, admission = Entrance(False, False), Admission(4)
    waiting.add_image("/image", image(5), 1)
    assert waiting.next_frame(admission) is None
    assert not waiting.set_calibration(Calibration(CAMERA))
    frame, frame_id = waiting.next_frame(admission)
    assert (frame.stamp_ns, frame_id, frame.camera) == (5, "cam", CAMERA)
    assert waiting.next_frame(admission) is None


def test_replay_keeps_all_and_live_keeps_the_newest_and_counts():
    for live, expected, dropped in ((False, [5, 6, 7], 0), (True, [7], 2)):
        waiting, admission = entrance(live), Admission(9)
        for number, stamp in enumerate((5, 6, 7)):
            waiting.add_image("/image", image(stamp), number)
        entered = []
        while (found := waiting.next_frame(admission)) is not None:
            entered.append(found[0].stamp_ns)
            admission.admit(found[0].stamp_ns)
        assert (entered, waiting.dropped_total) == (expected, dropped)


def test_images_that_the_middleware_overwrote_are_drops():
    waiting = entrance(live=True)
    waiting.add_image("/image", image(5), 40)
    waiting.next_frame(Admission(1))
    waiting.add_image("/image", image(9), 44)
    assert waiting.dropped_total == 3
    waiting.next_frame(Admission(1))
    waiting.add_image("/image", image(10), 2)  # the camera was restarted and counts anew
    waiting.add_image("/image/compressed", image(11), 900)  # another publisher
    assert waiting.dropped_total == 4, "one of the two was replaced, none was overwritten"


def test_numbers_of_two_publishers_are_no_gaps():
    waiting = entrance(live=True)
    waiting.forget_numbers()
    for stamp, number in ((5, 1), (6, 900), (7, 2), (8, 901)):
        waiting.add_image("/image", image(stamp), number)
        waiting.next_frame(Admission(1))
    assert waiting.dropped_total == 0


@pytest.mark.parametrize(
    ("bad", "complaint"),
    [
        (image(5), "frame 5 refused: header.stamp must increase"),
        (image(4), "frame 4 refused: header.stamp must increase"),
        (image(0), "must be positive"),
        (image(9, size=(5, 8)), "frame 9 refused: image is 8x5 px but camera_info is for 8x6 px"),
        (image(9, encoding="32FC1"), "encoding '32FC1' is not supported"),
    ],
)
def test_refused_images_are_counted_and_the_next_one_enters(bad, complaint):
    waiting, admission = entrance(), Admission(4)
    waiting.add_image("/image", image(5), 1)
    enter(waiting, admission)
    waiting.add_image("/image", bad, 2)
    waiting.add_image("/image", image(10), 3)
    with pytest.raises(FrameError, match=complaint):
        waiting.next_frame(admission)
    assert waiting.dropped_total == waiting.refusals.total == 1
    assert complaint.split(": ")[-1].strip(".*") in str(waiting.refusals)
    assert enter(waiting, admission) == 1


def test_a_frame_waits_for_its_own_mask_and_an_empty_one_says_nothing_was_found():
    waiting, admission = entrance(with_masks=True), Admission(4)
    waiting.add_image("/image", image(5), 1)
    waiting.add_mask(mask(6, empty=True))
    assert waiting.next_frame(admission) is None
    waiting.add_mask(mask(5))
    frame, _ = waiting.next_frame(admission)
    assert frame.given_mask.shape == (6, 8)
    admission.admit(5)
    waiting.add_image("/image", image(6), 2)
    frame, _ = waiting.next_frame(admission)
    assert frame.given_mask is None


def test_a_duplicate_does_not_wait_for_a_mask_that_is_gone():
    waiting, admission = entrance(with_masks=True), Admission(4)
    waiting.add_mask(mask(5))
    for number in (1, 2):
        waiting.add_image("/image", image(5), number)
    enter(waiting, admission)
    with pytest.raises(FrameError, match="must increase"):
        waiting.next_frame(admission)


def test_masks_without_images_do_not_pile_up():
    waiting = entrance(with_masks=True)
    for stamp in range(1, 1000):
        waiting.add_mask(mask(stamp))
    assert len(waiting._masks) <= 64
    for stamp in range(1, 10):  # the clock has stepped back
        waiting.add_mask(mask(stamp))
        waiting.add_image("/image", image(stamp), stamp)
        assert waiting.next_frame(Admission(1))[0].stamp_ns == stamp


def test_a_new_calibration_is_a_new_epoch_live_and_an_error_in_a_replay():
    other = Camera(CAMERA.K * 2 - np.diag([0, 0, 1]), 8, 6)
    live, replay = entrance(live=True), entrance()
    assert not live.set_calibration(Calibration(CAMERA))
    assert live.set_calibration(Calibration(other))
    with pytest.raises(FrameError, match="camera_info changes during the run"):
        replay.set_calibration(Calibration(other))


def test_a_calibration_that_jitters_is_no_new_one():
    for live in (True, False):
        waiting = entrance(live=live)
        for index in range(50):
            K = CAMERA.K * [[1 + 1e-8 * index] * 3, [1 - 1e-8 * index] * 3, [1] * 3]
            assert not waiting.set_calibration(Calibration(Camera(K, 8, 6)))
