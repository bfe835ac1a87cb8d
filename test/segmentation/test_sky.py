import cv2
import numpy as np
import pytest

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


def _image(border, brightest):
    image = np.full((120, 160, 3), border, np.uint8)
    image[50:70, 60:90] = brightest
    return image


@pytest.mark.parametrize(
    ("border", "brightest", "is_sky"),
    [
        ((1, 1, 1), 30, True),
        ((14, 15, 18), 200, True),  # a raised black level
        ((4, 15, 32), 200, False),  # a dark sea is blue, ...
        ((15, 15, 15), 89, False),  # ... or not so dark beside what is lit
        ((43, 43, 43), 230, False),
    ],
)
def test_a_dark_sea_is_no_black_sky(border, brightest, is_sky):
    assert dark_border_share(_image(border, brightest)) == float(is_sky)
