import cv2
import numpy as np
import pytest

from hat_ros.segmentation import region
from hat_ros.segmentation.masks import SIDES
from hat_ros.target.masks import overlap

_OUTWARD = {"left": (-1, 0), "right": (1, 0), "top": (0, -1), "bottom": (0, 1)}
_WIDTH, _HEIGHT = 120, 90


def panel_on_grass(center_xy, outward_xy):
    """A grey body whose blue panel points some way; picture and truth."""
    rgb = np.random.default_rng(0).normal((60, 120, 70), 8, (_HEIGHT, _WIDTH, 3)).clip(0, 255).astype(np.uint8)
    (x, y), (dx, dy) = center_xy, outward_xy
    tip = (x + 18 * dx, y + 18 * dy)
    truth = np.zeros((_HEIGHT, _WIDTH), np.uint8)
    for image, body, panel in ((rgb, (190, 185, 180), (40, 50, 120)), (truth, 1, 1)):
        cv2.rectangle(
            image, (min(x, tip[0]) - 6, min(y, tip[1]) - 6), (max(x, tip[0]) + 6, max(y, tip[1]) + 6), panel, -1
        )
        cv2.rectangle(image, (x - 12, y - 12), (x + 12, y + 12), body, -1)
    return rgb, truth


@pytest.mark.parametrize("side", SIDES)
def test_a_closed_cut_is_near_the_side_that_hides_a_part_and_opened_there_it_is_complete(side):
    dx, dy = _OUTWARD[side]
    center = (_WIDTH // 2 + dx * (_WIDTH // 2 - 18), _HEIGHT // 2 + dy * (_HEIGHT // 2 - 18))
    rgb, truth = panel_on_grass(center, (dx, dy))
    closed = region.cut_from_nothing(rgb)
    assert region.near_sides(closed) == (side,)
    assert overlap(closed, truth) < 0.95
    assert overlap(region.cut_from_nothing(rgb, side, closed), truth) > 0.97


def test_a_closed_cut_of_what_is_all_inside_is_near_no_side():
    rgb, truth = panel_on_grass((60, 45), (1, 0))
    closed = region.cut_from_nothing(rgb)
    assert overlap(closed, truth) > 0.97
    assert region.near_sides(closed) == ()
