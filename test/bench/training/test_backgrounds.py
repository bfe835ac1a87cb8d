import numpy as np
import pytest

from hat_ros.bench.training import backgrounds
from hat_ros.bench.training.backgrounds import HEIGHT, WIDTH, fractal_noise, render_background


def test_a_background_hangs_on_its_number_and_seed():
    first = render_background(3, 1)
    assert first.shape == (HEIGHT, WIDTH, 3)
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(render_background(3, 1), first)
    assert (render_background(4, 1) != first).any()
    assert (render_background(3, 2) != first).any()


@pytest.mark.parametrize("kind", sorted(backgrounds._MAKERS))
def test_every_kind_is_light(kind):
    images = np.stack([backgrounds._MAKERS[kind](np.random.default_rng(seed)) for seed in range(2)])
    assert images.shape == (2, HEIGHT, WIDTH, 3)
    assert np.isfinite(images).all()
    assert images.min() >= 0
    assert images.max() > 0.01  # one of them may lie in the night


def test_noise_is_even_and_smoother_for_a_steeper_spectrum():
    rough, smooth = (fractal_noise(np.random.default_rng(1), slope, 128) for slope in (0.5, 2.0))
    for noise in (rough, smooth):
        assert 0 <= noise.min() < 0.05 < 0.95 < noise.max() <= 1
    assert np.abs(np.diff(smooth)).mean() < 0.5 * np.abs(np.diff(rough)).mean()
