"""Which frames DROID compares: recorded edge lists of the released tracker, and the factor graph's bookkeeping."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hat_ros.motion.droid_graph import FactorGraph, ProximityRule, neighbour_pairs, proximity_pairs
from hat_ros.motion.droid_keyframes import Keyframes
from hat_ros.nets.droid_geometry import UNRELATED_DISTANCE, frame_distance, reproject

DATA = Path(__file__).parents[1] / "data"
NONE = np.zeros((0, 2), dtype=np.int64)


@pytest.fixture(scope="module")
def data():
    return np.load(DATA / "droid_graph.npz")


def geometry(data):
    return tuple(torch.from_numpy(data[name]) for name in ("poses", "disps", "intrinsics8"))


@pytest.mark.parametrize("beta", [0.3, 0.5])
def test_frame_distance_as_published(data, beta):
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(14), np.arange(14), indexing="ij"))
    distance = frame_distance(*geometry(data), torch.from_numpy(i), torch.from_numpy(j), beta)
    assert np.abs(distance.numpy().reshape(14, 14) - data[f"distance_beta{beta}"]).max() < 1e-5


def test_frames_behind_each_other_are_unrelated(data):
    poses, disparities, intrinsics = geometry(data)
    turned = poses.clone()
    turned[1] = torch.tensor([0.0, 0, 0, 0, 1, 0, 0])  # looks the other way
    distance = frame_distance(turned, disparities, intrinsics, torch.tensor([0]), torch.tensor([1]), 0.3)
    assert float(distance) == UNRELATED_DISTANCE


def test_reprojection_as_published(data):
    coords, _ = reproject(*geometry(data), torch.tensor([0, 3, 7]), torch.tensor([1, 5, 2]))
    assert np.abs(coords.numpy() - data["reproject_0-1_3-5_7-2"]).max() < 1e-5


def test_neighbours_as_published(data):
    assert np.array_equal(neighbour_pairs(0, 8, 3).T, data["neigh_r3"])


def test_front_end_edges_as_published(data):
    rule = ProximityRule(radius=2, nms=1, threshold=16.0, beta=0.3)
    chosen = proximity_pairs(data["distance_beta0.3"][9:], 9, 0, NONE, rule, 48)
    assert np.array_equal(chosen.T, data["prox_front"])


def test_back_end_edges_as_published(data):
    rule = ProximityRule(radius=2, nms=3, threshold=22.0, beta=0.3)
    assert np.array_equal(proximity_pairs(data["distance_beta0.3"], 0, 0, NONE, rule, 16 * 14).T, data["prox_back"])


def test_initial_edges_as_published(data):
    """Proximity after the neighbours of the first eight frames."""
    neighbours = neighbour_pairs(0, 8, 3)
    rule = ProximityRule(radius=2, nms=2, threshold=16.0, beta=0.25)
    chosen = proximity_pairs(data["distance_beta0.3"], 0, 0, neighbours, rule, 48)
    known = set(map(tuple, neighbours))
    new = [pair for pair in map(tuple, chosen) if pair not in known]
    assert np.array_equal(np.concatenate([neighbours, new]).T, data["prox_init"])


def test_narrow_radius_edges_as_published(data):
    """Four of these pairs are equally far apart up to rounding, so their order is not compared."""
    rule = ProximityRule(radius=1, nms=1, threshold=3.0, beta=0.3)
    chosen = proximity_pairs(data["distance_beta0.3"], 0, 0, NONE, rule, 1000)
    assert set(map(tuple, chosen)) == set(map(tuple, data["prox_tight"].T))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(0, 3))
def test_edges_come_in_both_directions_once_and_below_the_threshold(seed, radius, nms):
    rng = np.random.default_rng(seed)
    n, first = int(rng.integers(4, 14)), int(rng.integers(0, 3))
    distance = rng.uniform(0, 200, (n - first, n))
    rule = ProximityRule(radius, nms, 60.0, 0.3)
    pairs = list(map(tuple, proximity_pairs(distance, first, 0, NONE, rule, 1000)))
    assert len(set(pairs)) == len(pairs)
    assert pairs[1::2] == [(b, a) for a, b in pairs[::2]]
    for a, b in pairs[::2]:
        assert b < a
        assert a - b <= radius + 1 or distance[a - first, b] <= 60.0


class Stub:
    """A flow model of one channel whose correlation only remembers which edges it holds."""

    dtype = torch.float32

    def correlation(self, features_i, features_j, stored):
        return Remember(torch.stack([features_i[:, 0, 0, 0], features_j[:, 0, 0, 0]], dim=1))

    def refine(self, hidden, inp, lookup, motion):
        zero = torch.zeros(len(hidden), *hidden.shape[-2:], 2)
        return hidden + 1, zero, zero + 0.5

    def damping(self, hidden, group, n_groups):
        return torch.full((n_groups, *hidden.shape[-2:]), 1e-2)


class Remember:
    def __init__(self, edges):
        self.edges = edges

    def lookup(self, coords):
        return coords.permute(0, 3, 1, 2)

    def select(self, index):
        self.edges = self.edges[index]

    def append(self, other):
        self.edges = torch.cat([self.edges, other.edges])


@pytest.fixture
def graph():
    keyframes = Keyframes(16, torch.tensor([6.0, 6.0, 4.0, 3.0]), (6, 8), torch.float32)
    for i in range(10):
        keyframes.append(i, *(torch.full((1, 1, 6, 8), float(i)) for _ in range(3)))
        keyframes.poses[i, 0] = -0.05 * i
    return FactorGraph(Stub(), keyframes, max_factors=12)


def edges(graph):
    return [tuple(map(int, pair)) for pair in zip(graph.ii, graph.jj, strict=True)]


def in_step(graph):
    """Host lists and device tensors of the edges describe the same edges."""
    n = len(graph)
    assert len(graph.age) == len(graph.hidden) == len(graph.target) == len(graph.weight) == n
    assert len(graph.ii_inactive) == len(graph.target_inactive) == len(graph.weight_inactive)
    names = graph.keyframes.features[:, 0, 0, 0]
    expected = [(float(names[i]), float(names[j])) for i, j in edges(graph)]
    assert [tuple(pair) for pair in graph.correlation.edges.tolist()] == expected


def test_duplicates_are_dropped(graph):
    graph.add(np.array([[0, 1], [1, 0]]))
    graph.add(np.array([[1, 0], [1, 2]]))
    assert edges(graph) == [(0, 1), (1, 0), (1, 2)]
    graph.drop(np.array([True, False, False]), retire=True)
    graph.add(np.array([[0, 1]]))
    assert edges(graph) == [(1, 0), (1, 2)]
    in_step(graph)


def test_old_edges_make_room(graph):
    graph.add(neighbour_pairs(0, 4, 2))
    graph.update(1)
    graph.add(neighbour_pairs(4, 7, 2), make_room=True)
    assert len(graph) <= 12 and len(graph.ii_inactive) > 0
    assert all(pair in edges(graph) for pair in map(tuple, neighbour_pairs(4, 7, 2)))
    in_step(graph)


def test_removing_a_keyframe_renumbers_everything(graph):
    graph.add(neighbour_pairs(0, 6, 2))
    graph.drop(graph.ii < 2, retire=True)
    names = graph.keyframes.features[:, 0, 0, 0].clone()
    graph.remove_keyframe(3)
    assert graph.keyframes.stamps_ns == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    assert torch.equal(graph.keyframes.features[:9, 0, 0, 0], names[[0, 1, 2, 4, 5, 6, 7, 8, 9]])
    assert (3, 4) in edges(graph) and max(graph.ii.max(), graph.jj.max()) == 4
    assert (2, 3) in edges(graph)  # was (2, 4)
    in_step(graph)


def test_retiring_keyframes_renumbers_and_forgets_their_retired_edges(graph):
    graph.add(neighbour_pairs(0, 6, 1))
    graph.drop(graph.ii < 3, retire=True)
    assert graph.oldest_needed() == 1
    graph.drop((graph.ii < 4) | (graph.jj < 4), retire=True)
    assert graph.oldest_needed() == 2
    graph.retire_keyframes(2)
    assert graph.keyframes.stamps_ns == list(range(2, 10)) and graph.keyframes.retired == 2
    assert edges(graph) == [(2, 3), (3, 2)]
    assert min(graph.ii_inactive.min(), graph.jj_inactive.min()) == 0
    in_step(graph)


def test_update_ages_edges_and_fixes_the_first_poses(graph):
    graph.add(neighbour_pairs(2, 6, 2))
    before = graph.keyframes.poses.clone()
    graph.update(use_inactive=True)
    assert (graph.age == 1).all()
    assert torch.equal(before[:3], graph.keyframes.poses[:3])
    assert torch.equal(before[6:], graph.keyframes.poses[6:])
    assert float(graph.weight.min()) == 0.5


def test_keyframes_grow_without_losing_anything(graph):
    frames = graph.keyframes
    before = [tensor.clone() for tensor in (frames.poses, frames.features, frames.disparities)]
    frames.grow()
    assert frames.capacity == 32
    for old, new in zip(before, (frames.poses, frames.features, frames.disparities), strict=True):
        assert torch.equal(new[:10], old[:10]) and len(new) == 32
