"""Fewer triangles, the same outline: flat faces stay flat, edges stay sharp, colours stay where they were."""

import logging

import numpy as np
import pytest
import trimesh

from hat_ros.geometry import lie
from hat_ros.target import loading
from hat_ros.target.loading import target_from_scene
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.simplify import MAX_WORK_FACES, simplify
from hat_ros.types import Camera

CAMERA = Camera(np.array([[600.0, 0, 199.5], [0, 600.0, 199.5], [0, 0, 1]]), 400, 400)


def craft(levels):
    """A box with a ball and a thin double-sided plate, in three colours."""
    parts = [
        (trimesh.creation.box((1.0, 0.8, 0.6)), [200, 30, 30, 255]),
        (
            trimesh.creation.icosphere(subdivisions=1, radius=0.35).apply_translation([0.2, 0.1, 0.55]),
            [30, 200, 30, 255],
        ),
        (trimesh.creation.box((2.0, 0.5, 0.01)).apply_translation([1.6, 0, 0]), [30, 30, 200, 255]),
    ]
    scene = trimesh.Scene()
    for mesh, color in parts:
        for _ in range(levels):
            mesh = mesh.subdivide()
        mesh.visual = trimesh.visual.ColorVisuals(mesh, face_colors=np.tile(color, (len(mesh.faces), 1)))
        scene.add_geometry(mesh)
    return scene


@pytest.fixture
def small_limit(monkeypatch):
    monkeypatch.setattr(loading, "MAX_WORK_FACES", 20_000)
    monkeypatch.setattr(loading, "simplify", lambda corners: simplify(corners, 12_000))


def test_the_outline_and_the_colours_are_those_of_the_full_model(small_limit, caplog):
    caplog.set_level(logging.INFO)
    coarse, fine = target_from_scene(craft(2), "coarse"), target_from_scene(craft(5), "fine")
    assert len(coarse.faces) < 2000 and len(fine.faces) <= 12_000
    assert "triangles, simplified to" in caplog.text
    np.testing.assert_allclose(fine.vertices_m.min(axis=0), coarse.vertices_m.min(axis=0), atol=0.01)
    np.testing.assert_allclose(fine.vertices_m.max(axis=0), coarse.vertices_m.max(axis=0), atol=0.01)
    assert fine.face_areas_m2.sum() == pytest.approx(coarse.face_areas_m2.sum(), rel=0.02)
    for rotvec in ([0.4, 0.3, 0.1], [1.6, -0.4, 0.8], [2.5, 1.3, 0.2]):
        T = lie.transform(lie.so3_exp(np.array(rotvec)), np.array([-0.4, 0, 5.0]))
        a, b = (RayRenderer(target).render(T, CAMERA) for target in (coarse, fine))
        assert (a.mask & b.mask).sum() / (a.mask | b.mask).sum() > 0.97
        both = a.mask & b.mask
        assert np.median(np.abs(a.rgb[both].astype(int) - b.rgb[both])) <= 2


def test_flat_faces_stay_flat_and_corners_sharp():
    box = trimesh.creation.box((2.0, 1.0, 1.0))
    for _ in range(7):
        box = box.subdivide()
    fewer = simplify(np.array(box.triangles), 40_000)
    assert 5000 < len(fewer.corners) <= 40_000 and fewer.keep.sum() == len(fewer.corners)
    points = fewer.corners.reshape(-1, 3)
    on_surface = np.abs(np.abs(points) - [1.0, 0.5, 0.5]).min(axis=1)
    assert on_surface.max() < 1e-9
    for corner in np.array(np.meshgrid([-1, 1], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, -1).T:
        assert np.linalg.norm(points - corner, axis=1).min() < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_no_vertex_moves_by_more_than_a_cell(seed):
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(20_000, 1, 3)) + 0.02 * rng.normal(size=(20_000, 3, 3))
    fewer = simplify(corners, 3000)
    assert np.isfinite(fewer.corners).all()
    moved = np.linalg.norm(fewer.corners - corners[fewer.keep], axis=-1)
    assert moved.max() <= 2 * np.sqrt(3) * fewer.cell


def test_usual_models_are_left_alone():
    scene = craft(4)
    count = sum(len(mesh.faces) for mesh in scene.geometry.values())
    assert 5000 < count < MAX_WORK_FACES
    assert len(target_from_scene(scene, "usual").faces) == count
