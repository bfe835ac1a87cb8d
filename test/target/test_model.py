"""What follows from the triangles of a model."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from trimesh.visual.material import PBRMaterial

from hat_ros.target.loading import target_from_scene


def test_texture_coordinates_wrap_and_v_points_up():
    image = Image.new("RGB", (2, 2))
    image.putdata([(1, 0, 0), (2, 0, 0), (3, 0, 0), (4, 0, 0)])  # rows from the top
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    mesh.visual = trimesh.visual.TextureVisuals(
        uv=[[0.25, 0.25], [0.75, 0.25], [1.25, 1.75]], material=PBRMaterial(baseColorTexture=image)
    )
    target = target_from_scene(trimesh.Scene(mesh), "f")
    face = np.zeros(3, np.int32)
    np.testing.assert_array_equal(target.surface.sample(face, np.eye(3), target.face_rgb)[:, 0], [3, 4, 1])


def test_diameter_of_a_flat_model():
    mesh = trimesh.Trimesh([[0, 0, 0], [3, 0, 0], [0, 4, 0]], [[0, 1, 2]], process=False)
    assert target_from_scene(trimesh.Scene(mesh), "h").diameter_m == pytest.approx(5)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_diameter_is_the_largest_vertex_distance(seed):
    points = np.random.default_rng(seed).normal(size=(30, 3))
    mesh = trimesh.Trimesh(points, np.arange(30).reshape(-1, 3), process=False)
    target = target_from_scene(trimesh.Scene(mesh), "i")
    brute = np.linalg.norm(points[:, None] - points[None], axis=-1).max()
    assert target.diameter_m == pytest.approx(brute, rel=1e-9)


def test_faces_of_a_box():
    extents = np.array([1.0, 2.0, 3.0])
    target = target_from_scene(trimesh.Scene(trimesh.creation.box(extents)), "box")
    normals = target.face_normals
    np.testing.assert_allclose(np.abs(normals).max(axis=1), 1.0, atol=1e-12)
    outwards = target.corners_m.mean(axis=1) - target.center_m
    assert (np.einsum("fk,fk->f", normals, outwards) > 0).all()
    assert target.face_areas_m2.sum() == pytest.approx(2 * (2 + 3 + 6))


def test_the_hull_holds_the_corners_alone_and_a_flat_model_is_its_own():
    bumpy = trimesh.creation.box((2.0, 2.0, 2.0)).subdivide()
    bumpy.vertices[np.abs(bumpy.vertices).min(axis=1) < 0.5] *= 0.9
    assert len(target_from_scene(trimesh.Scene(bumpy), "dented").hull_m) == 8
    flat = trimesh.Trimesh([[0, 0, 0], [3, 0, 0], [0, 4, 0]], [[0, 1, 2]], process=False)
    assert len(target_from_scene(trimesh.Scene(flat), "flat").hull_m) == 3
