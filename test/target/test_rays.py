"""One ray-casting scene for all who use a model, and the two ray casters against each other."""

import gc
import threading
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from hat_ros.bench.synth.models import build_target
from hat_ros.config import load_config
from hat_ros.geometry import lie
from hat_ros.target import rays
from hat_ros.target.bvh import BvhCaster
from hat_ros.target.embree import EmbreeCaster
from hat_ros.target.loading import target_from_scene
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.rays import build_caster, ray_caster
from hat_ros.tracker import HatTracker
from hat_ros.types import Camera


@pytest.fixture
def built(monkeypatch):
    """The scenes built during a test: the triangles of each."""
    counted = []

    def build(corners_m):
        counted.append(corners_m)
        return build_caster(corners_m)

    monkeypatch.setattr(rays, "build_caster", build)
    return counted


def bundle(target, n=4000, seed=0):
    """Rays (n, 3), (n, 3) from around a target and from inside it, towards anywhere near it."""
    rng = np.random.default_rng(seed)
    size = target.bounding_radius_m
    origins = target.center_m + size * rng.uniform(0.0, 4.0, (n, 1)) * rng.normal(size=(n, 3))
    aims = target.center_m + 0.5 * size * rng.normal(size=(n, 3))
    return origins.astype(np.float32), (aims - origins).astype(np.float32)


def test_a_tracker_builds_one_scene(built):
    target = build_target("observer")
    tracker = HatTracker(load_config("default"), target)
    assert len(built) == 1
    assert tracker.segmentation is not None and ray_caster(target) is ray_caster(target)
    assert len(built) == 1


def test_equal_models_share_a_scene_and_others_do_not(built):
    first, same = build_target("cubesat"), build_target("cubesat")
    shared = ray_caster(first)
    assert ray_caster(same) is shared
    larger = replace(first, vertices_m=1.01 * first.vertices_m)  # the digest of a model that was altered is stale
    assert ray_caster(larger) is not shared
    assert len(built) == 2


def test_a_scene_goes_with_its_last_user(built):
    target = build_target("cubesat")
    renderer = RayRenderer(target)
    assert ray_caster(target) is renderer.caster
    del renderer
    gc.collect()
    ray_caster(target)
    assert len(built) == 2


def test_threads_that_ask_at_once_get_one_scene(built):
    target, found, start = build_target("freighter"), [], threading.Barrier(6)

    def ask():
        start.wait()
        found.append(ray_caster(target))

    threads = [threading.Thread(target=ask) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(built) == 1 and len({id(caster) for caster in found}) == 1


@pytest.mark.parametrize("name", ["probe", "observer", "freighter"])
def test_both_casters_find_the_same_hits(name):
    target = build_target(name)
    a, b = (kind(target.corners_m).trace(*bundle(target)) for kind in (EmbreeCaster, BvhCaster))
    assert [array.dtype for array in a] == [array.dtype for array in b]
    hit = a.face >= 0
    assert 0.1 < hit.mean() < 0.99
    # A ray along an edge may meet either face or slip past.
    assert (hit != (b.face >= 0)).mean() < 1e-3
    both = hit & (b.face >= 0)
    assert (np.abs(a.distance - b.distance)[both] > 1e-4).mean() < 1e-3
    same = both & (a.face == b.face)
    assert same.sum() > 0.9 * both.sum(), "of faces that coincide, where parts touch, either may be named"
    assert np.abs(a.barycentric - b.barycentric)[same].max() < 1e-2


@pytest.mark.parametrize("name", ["probe", "freighter"])
def test_both_casters_find_the_same_shadows(name):
    target = build_target(name)
    a, b = (kind(target.corners_m).occluded(*bundle(target, seed=1)) for kind in (EmbreeCaster, BvhCaster))
    assert a.dtype == b.dtype == np.bool_ and 0.1 < a.mean() < 0.99
    assert (a != b).mean() < 1e-3


@pytest.mark.parametrize("kind", [EmbreeCaster, BvhCaster])
def test_rays_along_the_axes_of_a_box(kind):
    """Boxes of no thickness and directions without a component along an axis."""
    caster = kind(target_from_scene(trimesh.Scene(trimesh.creation.box((2.0, 2.0, 2.0))), "box").corners_m)
    origins = np.array([[0.3, 0.2, -5.0], [-5.0, 0.3, 0.2], [0.3, 5.0, 0.2], [0.3, 0.2, 0.0], [3.0, 0.2, -5.0]])
    directions = np.array([[0, 0, 2.0], [1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, 1]])
    hits = caster.trace(origins, directions)
    np.testing.assert_allclose(hits.distance[:4], [2.0, 4.0, 4.0, 1.0], rtol=1e-6)
    assert hits.face[4] == -1
    np.testing.assert_array_equal(caster.occluded(origins, directions), [True, True, True, True, False])


def test_without_embreex_the_silhouette_is_the_same(monkeypatch):
    target = build_target("observer")
    T = lie.transform(lie.so3_exp(np.array([1.0, 0.3, 0.1])), np.array([0, 0, 6.0]))
    camera = Camera(np.array([[200.0, 0, 63], [0, 210, 47.5], [0, 0, 1]]), 128, 96)
    with_embree = RayRenderer(target).render(T, camera)
    monkeypatch.setattr(rays, "find_spec", lambda name: None)
    renderer = RayRenderer(target)
    renderer.caster = build_caster(target.corners_m)
    assert isinstance(renderer.caster, BvhCaster)
    without = renderer.render(T, camera)
    assert np.count_nonzero(with_embree.mask != without.mask) <= 2
    both = with_embree.mask & without.mask
    np.testing.assert_allclose(with_embree.depth_m[both], without.depth_m[both], atol=1e-2)
    assert (with_embree.rgb != without.rgb)[both].any(axis=1).mean() < 5e-3
