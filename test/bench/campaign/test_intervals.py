"""Intervals against published numbers and against what a sample must give."""

import numpy as np
import pytest

from hat_ros.bench.campaign.intervals import bootstrap, median, ratio, wilson


@pytest.mark.parametrize(
    ("count", "total", "low", "high"),
    # Newcombe, "Two-sided confidence intervals for the single proportion", Statistics in Medicine 17 (1998), table I.
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson(count, total, low, high):
    assert wilson(count, total) == pytest.approx((low, high), abs=6e-5)
    mirrored = wilson(total - count, total)
    assert mirrored == pytest.approx((1 - high, 1 - low), abs=6e-5)


def test_wilson_without_cases():
    assert np.isnan(wilson(0, 0)).all()


def test_median_of_clips_that_were_never_right():
    assert median(np.array([[1.0, 3.0, np.inf]]))[0] == 3
    assert median(np.array([[1.0, 3.0, np.inf, np.inf]]))[0] == np.inf
    assert median(np.array([[np.inf, np.inf]]))[0] == np.inf


def test_a_ratio_is_of_sums():
    samples = np.array([[[1.0, 2.0], [0.0, 8.0]], [[0.0, 0.0], [0.0, 0.0]]])
    assert ratio(samples)[0] == 0.1
    assert np.isnan(ratio(samples)[1])


def test_bootstrap_covers_and_repeats():
    values = np.random.default_rng(3).normal(5, 1, 400)
    low, high = bootstrap(values, lambda samples: samples.mean(axis=1))
    assert (low, high) == bootstrap(values, lambda samples: samples.mean(axis=1))
    # The mean of 400 has a standard error of 0.05.
    assert high - low == pytest.approx(4 * 0.05, rel=0.15)
    assert low < values.mean() < high


def test_bootstrap_of_one_value_and_of_none():
    assert bootstrap(np.array([4.0]), median) == (4.0, 4.0)
    assert np.isnan(bootstrap(np.zeros(0), median)).all()
    assert np.isnan(bootstrap(np.zeros((3, 2)), ratio)).all()
