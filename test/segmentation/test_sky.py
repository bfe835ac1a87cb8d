import cv2
import numpy as np

from hat_ros.segmentation.sky import bridge_gaps, dark_border_share, lit_share


def _discs(radius_px):
    mask = np.zeros((240, 240), np.uint8)
    for x in range(80, 161, 16):
        for y in range(80, 161, 16):
            cv2.circle(mask, (x, y), radius_px, 1, -1)
    return mask


def test_the_lit_share_of_a_body_grows_with_its_parts():
    shares = [lit_share(_discs(radius)) for radius in (2, 4, 6)]
    assert shares == sorted(shares)
    assert shares[0] < 0.1 and shares[-1] > 0.4
    whole = np.zeros((240, 240), np.uint8)
    whole[80:120, 90:200] = 1
    assert lit_share(whole) > 0.99


def test_bridged_gaps_do_not_depend_on_the_image_around_the_body():
    """A small body in a large image is seen as finely as one that fills it."""
    small = _discs(5)
    large = np.zeros((960, 1280), np.uint8)
    large[500:740, 700:940] = small
    box, options = bridge_gaps(small, 96)
    box_in_large, options_in_large = bridge_gaps(large, 96)
    np.testing.assert_array_equal(large[box_in_large], small[box])
    for one, other in zip(options, options_in_large, strict=True):
        np.testing.assert_array_equal(one, other)


def test_wider_bridges_cover_what_narrower_ones_do():
    _, options = bridge_gaps(_discs(5), 96)
    areas = [np.count_nonzero(option) for option in options]
    assert areas == sorted(areas) and areas[-1] > 1.5 * areas[0]


def test_a_dark_sea_is_no_black_sky():
    sea = np.full((120, 160, 3), (4, 15, 32), np.uint8)
    assert dark_border_share(sea) == 0.0
    assert dark_border_share(np.full((120, 160, 3), (14, 15, 18), np.uint8)) == 1.0
