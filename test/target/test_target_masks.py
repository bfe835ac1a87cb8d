"""Overlap and moments against their definitions."""

import numpy as np
import pytest

from hat_ros.target.masks import image_moments, mask_moments, overlap


def test_overlap():
    a, b = np.zeros((4, 6), np.bool_), np.zeros((4, 6), np.bool_)
    assert overlap(a, b) == 0.0
    a[:2, :4], b[1:3, :4] = True, True
    assert overlap(a, b) == overlap(a.view(np.uint8), b.view(np.uint8)) == pytest.approx(4 / 12)


def test_moments_of_a_disc():
    y, x = np.mgrid[:100, :120]
    disc = (x - 60) ** 2 + (y - 45) ** 2 <= 30**2
    for moments in (mask_moments(disc), mask_moments(disc.view(np.uint8)), image_moments(7 * disc.astype(np.float32))):
        np.testing.assert_allclose(moments.center_px, [60, 45], atol=1e-6)
        assert moments.gyration_px == pytest.approx(30 / np.sqrt(2), rel=0.01)


def test_moments_of_a_mask_are_those_of_its_pixels():
    mask = np.random.default_rng(0).random((40, 60)) > 0.7
    pixels = np.argwhere(mask)[:, ::-1]
    moments = mask_moments(mask)
    np.testing.assert_allclose(moments.center_px, pixels.mean(axis=0), rtol=1e-12)
    assert moments.variance_px2 == pytest.approx(pixels.var(axis=0).sum(), rel=1e-9)


def test_a_single_pixel_is_a_square():
    mask = np.zeros((5, 5), np.bool_)
    mask[1, 3] = True
    moments = mask_moments(mask)
    np.testing.assert_array_equal(moments.center_px, [3.0, 1.0])
    assert moments.variance_px2 == 0.0 and moments.gyration_px == pytest.approx(np.sqrt(1 / 6))
