import numpy as np

from hat_ros.bench.training.coding import decode, encode


def test_a_radiance_comes_back():
    radiance = np.linspace(0, 2, 1000, dtype=np.float32)
    assert np.abs(np.sqrt(decode(encode(radiance))) - np.sqrt(radiance)).max() < 1 / 256


def test_dark_levels_are_finer_than_bright_ones():
    levels = np.diff(decode(np.arange(256, dtype=np.uint8)))
    assert (np.diff(levels) > 0).all()
    assert levels[0] < 1e-4


def test_what_is_too_bright_is_cut_off():
    assert decode(encode(np.array([5.0, -1.0], np.float32))).tolist() == [2.0, 0.0]
