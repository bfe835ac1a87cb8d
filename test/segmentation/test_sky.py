import cv2
import numpy as np

from hat_ros.segmentation.sky import is_scattered


def _discs(radius_px):
    mask = np.zeros((240, 240), np.uint8)
    for x in range(80, 161, 16):
        for y in range(80, 161, 16):
            cv2.circle(mask, (x, y), radius_px, 1, -1)
    return mask


def test_specks_are_scattered_and_large_parts_with_gaps_between_them_are_not():
    """Bridging the gaps between specks shows the body; between wings and hull it fills what is sky."""
    assert is_scattered(_discs(2))
    assert not is_scattered(_discs(6))
