"""Polar grids against direct sampling."""

import numpy as np
import pytest

from hat_ros.target.polar import PolarSampler, border_grid, polar_grid


@pytest.mark.parametrize("gyration_px", [8.0, 30.0, 55.0])
def test_a_sampler_of_many_grids_gives_what_the_whole_image_gives(gyration_px):
    image = np.zeros((120, 160), np.float32)
    image[:50, 60:120] = 0.5
    image[20:70, 90:160] = 1.0
    sampler = PolarSampler(image)
    for center in ((100.0, 40.0), (70.3, 12.8), (159.0, 60.0)):
        grid = sampler.grid(np.array(center), gyration_px, 24)
        whole = image + np.float32(1e-30)  # nothing is black: nothing is left out
        np.testing.assert_allclose(grid, polar_grid(whole, np.array(center), gyration_px, 24), atol=1e-6)


def test_the_border_grid_is_that_of_ones():
    ones = np.ones((120, 160), np.float32)
    for center in ((80.0, 60.0), (3.0, 100.0)):
        inside = border_grid(ones.shape, np.array(center), 30.0, 24)
        np.testing.assert_allclose(inside, polar_grid(ones, np.array(center), 30.0, 24), atol=0.06)
