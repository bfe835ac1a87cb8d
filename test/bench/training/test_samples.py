import numpy as np
import pytest

from hat_ros.bench.training import samples
from hat_ros.bench.training.samples import Composer

SIDE = 64


@pytest.fixture(scope="module")
def composer(views, backgrounds) -> Composer:
    return Composer(views, backgrounds, 7, SIDE)


@pytest.fixture(scope="module")
def many(composer):
    return [composer.sample(number) for number in range(150)]


def test_a_sample_hangs_on_its_number_alone(views, backgrounds, composer, many):
    again = Composer(views, backgrounds, 7, SIDE).sample(17)
    for name, value in vars(many[17]).items():
        np.testing.assert_array_equal(getattr(again, name), value)
    other = Composer(views, backgrounds, 8, SIDE).sample(17)
    assert (other.rgb != many[17].rgb).any()


def test_shapes_and_ranges(many):
    for sample in many:
        assert sample.rgb.shape == (SIDE, SIDE, 3)
        assert sample.rgb.dtype == np.uint8
        assert sample.prior.shape == (SIDE // 2, SIDE // 2)
        assert sample.target.shape == sample.weight.shape == (SIDE, SIDE)
        assert 0 <= sample.target.min() <= sample.target.max() <= 1 + 1e-6
        assert set(np.unique(sample.weight)) <= {0.0, 1.0}


def test_a_prior_is_a_silhouette_or_zero_everywhere(many):
    without = [sample for sample in many if not sample.prior.any()]
    assert 0.3 < len(without) / len(many) < 0.65
    for sample in many:
        if sample.prior.any():
            assert np.abs(sample.prior).max() <= 0.5 + 1e-6
            assert (sample.prior == -0.5).any()


def test_beyond_the_border_there_is_nothing_to_be_told(many):
    cut = [sample for sample in many if not sample.weight.all()]
    assert cut
    for sample in cut:
        beyond = sample.weight == 0
        assert not sample.rgb[beyond].any()
        assert not sample.target[beyond].any()
        rows, columns = beyond.all(axis=1), beyond.all(axis=0)
        assert beyond.sum() in (SIDE * rows.sum(), SIDE * columns.sum())


def test_some_samples_hold_no_target(many):
    empty = sum(not sample.target.any() for sample in many)
    assert 1 <= empty < 0.15 * len(many)


def test_behind_an_occluder_nothing_is_told(composer):
    coverage = np.zeros((SIDE, SIDE), np.float32)
    coverage[16:48, 16:48] = 1
    image = np.zeros((SIDE, SIDE, 3), np.float32)
    changed = False
    for seed in range(5):
        painted, truth = composer._occlude(image, coverage, np.random.default_rng(seed))
        hidden = truth == 0.5
        assert (coverage[hidden] > 0.5).all()
        shown = ~hidden & (truth != coverage)
        assert (truth[shown] == 0).all()
        assert hidden.any()
        changed |= bool(painted[hidden].any())
    assert changed


def test_nothing_to_hide_is_left_alone(composer):
    nothing, image = np.zeros((SIDE, SIDE), np.float32), np.ones((SIDE, SIDE, 3), np.float32)
    painted, truth = composer._occlude(image, nothing, np.random.default_rng(0))
    assert painted is image
    assert truth is nothing


def test_one_half_is_seen_only_behind_occluders(views, backgrounds, monkeypatch):
    monkeypatch.setattr(Composer, "_occlude", lambda self, image, coverage, rng: (image, coverage))
    composer = Composer(views, backgrounds, 7, SIDE)
    halves = sum((composer.sample(number).target == 0.5).sum() for number in range(40))
    assert halves < 5  # a coverage of exactly one half at an edge


def test_a_mask_with_faults_is_still_a_mask():
    mask = np.zeros((40, 40), np.float32)
    mask[10:30, 10:30] = 1
    damaged = [samples._damaged(mask.copy(), np.random.default_rng(seed)) for seed in range(8)]
    assert all(set(np.unique(one)) <= {0.0, 1.0} for one in damaged)
    assert sum((one != mask).any() for one in damaged) > 4
