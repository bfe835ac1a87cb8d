"""Instances of one object keep their identity, in whatever order the entries stand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hat_ros.bench.datasets.instances import follow_instances
from hat_ros.errors import DatasetError


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.integers(2, 5))
def test_shuffled_entries_are_followed(seed, count):
    rng = np.random.default_rng(seed)
    starts = np.stack([np.arange(count) * 1.0, rng.normal(size=count), 5 + rng.normal(size=count)], axis=-1)
    speeds = rng.uniform(-0.02, 0.02, (count, 3))
    places, truth = {}, [{} for _ in range(count)]
    for number in range(0, 20, 2):
        order = rng.permutation(count)
        places[number] = {int(slot): starts[k] + number * speeds[k] for slot, k in enumerate(order)}
        for slot, k in enumerate(order):
            truth[k][number] = slot
    found = follow_instances(places, "x")
    assert sorted(map(sorted, map(dict.items, found))) == sorted(map(sorted, map(dict.items, truth)))


def test_one_that_is_hidden_comes_back_as_itself_and_a_new_one_is_new():
    a, b, c = np.array([0, 0, 5.0]), np.array([2, 0, 5.0]), np.array([-2, 0, 5.0])
    chains = follow_instances({0: {0: a, 1: b}, 1: {0: b}, 2: {0: b, 1: a}, 3: {0: c, 1: a, 2: b}}, "x")
    assert chains == [{0: 0, 2: 1, 3: 1}, {0: 1, 1: 0, 2: 0, 3: 2}, {3: 0}]


def test_those_that_cannot_be_told_apart_are_refused():
    a, b = np.array([0, 0, 5.0]), np.array([0.3, 0, 5.0])
    with pytest.raises(DatasetError, match=r"scene_gt.*image 7.* told apart"):
        follow_instances({6: {0: a, 1: b}, 7: {0: a + [0.2, 0.2, 0], 1: b + [0.2, 0.2, 0]}}, "scene_gt.json")
