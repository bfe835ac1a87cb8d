"""Depth of 16-bit values and range of luma: found from the past alone, and never less than what was seen."""

from __future__ import annotations

import numpy as np
import pytest

from hat_ros.io.value_range import ValueRange


def values(largest):
    return np.array([[0, largest]], np.uint16)


@pytest.mark.parametrize(
    ("largest", "bits"),
    [(0, 10), (255, 10), (1023, 10), (1024, 12), (4095, 12), (4096, 14), (16383, 14), (16384, 16), (65535, 16)],
)
def test_the_smallest_depth_that_holds_the_values_is_found(largest, bits):
    narrow, known = ValueRange.of_option("auto").narrow(values(largest))
    assert known.bits == bits
    assert narrow.tolist() == [[0, largest >> (bits - 8)]]


def test_a_dark_beginning_is_put_right_and_a_dark_frame_later_changes_nothing():
    known, found = ValueRange.of_option("auto"), []
    for largest in (300, 900, 40000, 300, 5000):
        narrow, known = known.narrow(values(largest))
        found.append((known.bits, int(narrow.max())))
    assert found == [(10, 75), (10, 225), (16, 156), (16, 1), (16, 19)]


@pytest.mark.parametrize("bits", range(8, 17))
def test_a_told_depth_stays_and_larger_values_saturate(bits):
    known = ValueRange.of_option(str(bits))
    narrow, after = known.narrow(np.array([0, 1 << (bits - 1), (1 << bits) - 1, 65535], np.uint16))
    assert narrow.tolist() == [0, 128, 255, 255]
    assert after == known


def test_luma_far_outside_the_range_of_video_is_full_from_then_on():
    video, full = np.full((100, 100), 16, np.uint8), np.zeros((100, 100), np.uint8)
    noisy = video.copy()
    noisy[0, :9] = 0  # less than a thousandth
    known = ValueRange()
    found = []
    for luma in (video, noisy, full, video):
        known = known.with_luma(luma)
        found.append(known.full_luma)
    assert found == [False, False, True, True]
