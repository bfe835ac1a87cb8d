import numpy as np
import pytest

from hat_ros.segmentation.masks import (
    Window,
    border_contact,
    fill_holes,
    moved,
    shift_between,
    touched_sides,
)
from hat_ros.target.masks import overlap

RNG = np.random.default_rng(5)


def block(rows, cols, shape=(60, 90)):
    mask = np.zeros(shape, np.uint8)
    mask[rows, cols] = 1
    return mask


def test_overlap_is_symmetric_and_bounded():
    a, b = block(slice(10, 30), slice(10, 30)), block(slice(20, 40), slice(10, 30))
    assert overlap(a, b) == overlap(b, a) == pytest.approx(1 / 3)
    assert overlap(a, a) == 1.0
    assert overlap(0 * a, 0 * a) == 0.0


@pytest.mark.parametrize("shift", [(0, 0), (5, -7), (-80, 3), (200, 0)])
def test_a_moved_mask_keeps_what_stays_inside(shift):
    mask = block(slice(20, 40), slice(30, 60))
    dx, dy = shift
    rows, cols = np.nonzero(mask)
    inside = (rows + dy >= 0) & (rows + dy < 60) & (cols + dx >= 0) & (cols + dx < 90)
    out = moved(mask, dx, dy)
    assert out.sum() == inside.sum()
    assert out[rows[inside] + dy, cols[inside] + dx].all()


def test_shift_between_finds_a_shift_unless_the_border_cuts():
    mask = block(slice(20, 40), slice(30, 60))
    assert shift_between(mask, moved(mask, 4, -6)) == (4, -6)
    assert shift_between(mask, moved(mask, 40, 0)) == (0, 0)
    assert shift_between(None, mask) == (0, 0)


def test_sides_and_contact():
    assert touched_sides(block(slice(0, 10), slice(80, 90))) == ("top", "right")
    assert border_contact(block(slice(20, 30), slice(20, 30))) == 0.0
    assert border_contact(block(slice(0, 60), slice(0, 90))) == pytest.approx(1.0, abs=0.02)


def test_only_small_holes_are_filled():
    mask = block(slice(5, 55), slice(5, 85))
    mask[10:12, 10:12] = 0
    mask[20:50, 20:70] = 0
    filled = fill_holes(mask, 0.1)
    assert filled[10:12, 10:12].all()
    assert not filled[25:45, 25:65].any()
    assert (fill_holes(mask, 10.0)[5:55, 5:85]).all()


@pytest.mark.parametrize("box", [(10, 5, 70, 50), (-20, -20, 30, 30), (60, 30, 200, 200)])
def test_a_window_reduces_and_enlarges_to_the_same_place(box):
    rgb = RNG.integers(0, 255, (120, 180, 3), dtype=np.uint8)
    mask = block(slice(20, 60), slice(30, 110), (120, 180))
    window = Window.around(rgb, box, 5.0, 64)
    back = window.enlarge(window.reduce(mask))
    part = mask[window.y0 : window.y0 + window.height, window.x0 : window.x0 + window.width]
    assert max(window.rgb.shape) <= 64
    assert overlap(back, part) > 0.9
    shifted = window.reduce(mask, (6, -4))
    assert np.array_equal(shifted, window.reduce(moved(mask, 6, -4)))


def test_a_window_outside_the_image_is_none():
    assert Window.around(np.zeros((60, 90, 3), np.uint8), (200, 200, 300, 300), 2.0, 64) is None
