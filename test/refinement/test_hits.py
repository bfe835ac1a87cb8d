"""Compiled loops over what rays hit, against the same in numpy."""

import numpy as np
import pytest

from hat_ros.geometry import lie
from hat_ros.refinement.hits import facing, hit_points, image_box, normals_towards
from hat_ros.types import Camera

CAMERA = Camera(np.array([[500.0, 2.0, 320.0], [0.0, 490.0, 240.0], [0.0, 0.0, 1.0]]), 640, 480)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def _unit(rng, n):
    v = rng.normal(size=(n, 3)).astype(np.float32)
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def test_hit_points_lie_on_the_rays_that_hit(rng):
    origins, directions = _unit(rng, 50), _unit(rng, 50)
    face = rng.integers(-1, 3, 50).astype(np.int32)
    distance = rng.uniform(1, 5, 50).astype(np.float32)
    at, points = hit_points(origins, directions, face, distance)
    np.testing.assert_array_equal(at, np.flatnonzero(face >= 0))
    np.testing.assert_allclose(points, origins[at] + directions[at] * distance[at, None], atol=1e-6)


def test_normals_look_back_along_the_rays_and_only_their_sign_changes(rng):
    directions, of_faces = _unit(rng, 40), _unit(rng, 7)
    face = rng.integers(0, 7, 40).astype(np.int32)
    normals = normals_towards(directions, face, of_faces)
    assert (np.einsum("nk,nk->n", normals, directions) <= 0).all()
    np.testing.assert_allclose(np.abs(np.einsum("nk,nk->n", normals, of_faces[face])), 1, atol=1e-6)


def test_what_faces_the_sun_starts_its_shadow_ray_off_the_surface(rng):
    points, normals, sun = _unit(rng, 60), _unit(rng, 60), _unit(rng, 1)[0]
    at, cosine, start = facing(points, normals, sun, 0.1, 0.02)
    np.testing.assert_array_equal(at, np.flatnonzero(normals @ sun > 0.1))
    np.testing.assert_allclose(cosine, normals[at] @ sun, atol=1e-6)
    np.testing.assert_allclose(start - points[at], np.float32(0.02) * normals[at], atol=1e-6)


def test_the_box_holds_all_projections(rng):
    points = rng.normal(size=(30, 3))
    T = lie.transform(lie.so3_exp(np.array([0.3, -0.8, 0.5])), np.array([0.2, -0.1, 6.0]))
    uv = CAMERA.project(points @ T[:3, :3].T + T[:3, 3])
    box = image_box(points, np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]), CAMERA.K, 1e-3)
    np.testing.assert_allclose(box, np.concatenate([uv.min(axis=0), uv.max(axis=0)]))


@pytest.mark.parametrize("t", [(0.0, 0.0, -6.0), (0.0, 0.0, 0.5), (0.0, np.nan, 6.0), (0.0, 0.0, np.inf)])
def test_what_is_not_all_in_front_of_the_camera_has_no_box(rng, t):
    points = rng.normal(size=(30, 3))
    assert image_box(points, np.eye(3), np.array(t), CAMERA.K, 1e-3) is None
