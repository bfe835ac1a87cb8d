"""One object turns the messages of a camera into frames: size, lens, mask, and what it learns of the values."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from camera_info import LENSES, SIZE, WIRE, K, info, smooth_picture, through_lens

from hat_ros.errors import FrameError
from hat_ros.io.calibration import calibration_from
from hat_ros.io.frame_decoder import FrameDecoder

BARREL = LENSES["plumb_bob"]


def decoder(d=(0.0,) * 5, depth="auto", quiet=False):
    return FrameDecoder(calibration_from(info(d=d), "/image_raw", "auto"), depth, quiet)


def wide(largest, size=SIZE):
    values = np.zeros((size[1], size[0]), np.uint16)
    values[0, 0] = largest
    return WIRE.image(1, "cam", "mono16", values.view(np.uint8).reshape(size[1], size[0], 2))


def grey(size):
    return WIRE.image(1, "cam", "mono8", np.zeros(size[::-1], np.uint8))


def test_image_and_mask_lose_the_distortion_together():
    picture = smooth_picture()
    square = np.zeros(SIZE[::-1], np.uint8)
    square[60:180, 90:240] = 255
    raw = through_lens(picture, K, "plumb_bob", BARREL)
    raw_square = np.where(through_lens(square, K, "plumb_bob", BARREL) > 127, 255, 0).astype(np.uint8)
    frame = decoder(BARREL).frame(5, WIRE.image(5, "cam", "rgb8", raw), WIRE.image(5, "cam", "mono8", raw_square))
    assert np.array_equal(frame.camera.K, K)
    assert np.abs(frame.rgb.astype(int) - picture)[50:-50, 60:-60].mean() < 0.6
    assert np.count_nonzero(frame.given_mask != square) < 0.03 * np.count_nonzero(square)


@pytest.mark.parametrize("d", [(0.0,) * 5, BARREL])
@pytest.mark.parametrize("size", [(320, 200), (160, 120), (640, 480), (240, 320)])
def test_a_size_that_does_not_fit_names_both(d, size):
    what = rf"{size[0]}x{size[1]} px but camera_info is for 320x240 px"
    with pytest.raises(FrameError, match=f"image is {what}"):
        decoder(d).frame(5, grey(size))
    with pytest.raises(FrameError, match=f"detection mask is {what}"):
        decoder(d).frame(5, grey(SIZE), grey(size))
    assert decoder(d).mask(WIRE.image(1, "cam", "mono8", np.zeros((0, 0), np.uint8))) is None


def test_depth_is_learned_only_from_frames_that_may_enter():
    found = decoder()

    def brightest(stamp_ns, message, mask=None):
        try:
            return int(found.frame(stamp_ns, message, mask).rgb.max())
        except FrameError:
            return None

    assert brightest(10, wide(1000)) == 250
    assert brightest(10, wide(60000)) == 234, "the repeated frame itself is read by its own values"
    assert brightest(0, wide(60000)) == 234
    assert brightest(11, wide(60000, (160, 120))) is None
    assert brightest(12, wide(60000), grey((160, 120))) is None
    assert brightest(13, wide(1000)) == 250, "none of those is admitted, so none counts"
    assert brightest(14, wide(60000)) == 234
    assert brightest(15, wide(1000)) == 3


@pytest.mark.parametrize("quiet", [False, True])
def test_what_was_chosen_is_said_once(caplog, quiet):
    caplog.set_level(logging.INFO, "hat_ros")
    found = decoder(BARREL, quiet=quiet)
    for stamp_ns, largest in enumerate((900, 900, 3000, 900), 1):
        found.frame(stamp_ns, wide(largest))
    luma = WIRE.image(9, "cam", "yuyv", np.full((*SIZE[::-1], 2), [0, 128], np.uint8))
    found.frame(9, luma)
    texts = [record.getMessage() for record in caplog.records]
    expected = [
        "the images are raw: their distortion (plumb_bob) is undone",
        "16-bit images are read as 10-bit ones (option image_depth)",
        "16-bit images are read as 12-bit ones, not as 10-bit ones as up to now (option image_depth)",
        "YUV images are read with luma from 0 to 255, not from 16 to 235",
    ]
    assert texts == ([] if quiet else expected)
