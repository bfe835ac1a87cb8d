"""Laws of the light: Lambert, shadows, gloss, coverage."""

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from hat_ros.bench.synth.sunlit import Light, SunlitRenderer, smoothed_normals
from hat_ros.geometry import lie
from hat_ros.target.loading import target_from_scene
from hat_ros.types import Camera

CAMERA = Camera(np.array([[200.0, 0.0, 63.5], [0.0, 200.0, 47.5], [0.0, 0.0, 1.0]]), 128, 96)
AHEAD = lie.transform(np.eye(3), np.array([0.0, 0.0, 4.0]))


def white(mesh):
    mesh.visual.face_colors = np.full((len(mesh.faces), 4), 255, np.uint8)
    return target_from_scene(trimesh.Scene(mesh), "white")


def render(target, to_sun, ambient=0.0, gloss=0.0):
    return SunlitRenderer(target, gloss=gloss).render(AHEAD, CAMERA, Light(np.array(to_sun, float), ambient))


def test_a_white_face_square_to_the_sun_is_one_and_falls_with_the_cosine():
    box = white(trimesh.creation.box((1, 1, 1)))
    radiance, coverage = render(box, [0, 0, -1])
    assert radiance[48, 64] == pytest.approx(1.0, abs=1e-4) and coverage[48, 64] == 1
    radiance, _ = render(box, [np.sin(1.0), 0, -np.cos(1.0)])
    assert radiance[48, 64] == pytest.approx(np.cos(1.0), abs=1e-4)


def test_a_back_lit_face_has_ambient_light_only():
    radiance, _ = render(white(trimesh.creation.box((1, 1, 1))), [0, 0, 1], ambient=0.02)
    assert radiance[48, 64] == pytest.approx(0.02, abs=1e-5)


def test_parts_cast_shadows():
    wall, screen = trimesh.creation.box((2, 2, 0.1)), trimesh.creation.box((0.4, 0.4, 0.1))
    screen.apply_translation([0.6, 0, -1.0])  # between the wall and a sun at the right, seen beside its shadow
    target = white(trimesh.util.concatenate([wall, screen]))
    radiance, _ = render(target, [1.0, 0, -1.6])
    x_shadow = 0.6 - 1.0 / 1.6
    pose = CAMERA.project(np.array([x_shadow, 0.0, 3.95]))
    u, v = np.rint(pose).astype(int)
    assert radiance[v, u].max() == 0
    assert radiance[v, 15].min() > 0.5


def test_gloss_peaks_in_the_mirror_direction():
    target = white(trimesh.creation.box((1, 1, 1)))
    values = [render(target, [np.sin(a), 0, -np.cos(a)], gloss=1.0)[0][48, 64, 0] / np.cos(a) for a in (0.0, 0.3, 0.8)]
    assert values[0] > values[1] > values[2] >= 1.0 - 1e-4


def test_coverage_is_partial_at_edges_only_and_radiance_is_premultiplied():
    radiance, coverage = render(white(trimesh.creation.box((1, 1, 1))), [0, 0, -1])
    edge = (coverage > 0) & (coverage < 1)
    assert edge.any() and set(np.unique(coverage)) <= {0.0, 0.25, 0.5, 0.75, 1.0}
    np.testing.assert_allclose(radiance[edge, 0], coverage[edge], atol=1e-4)
    assert not radiance[coverage == 0].any()


def test_smoothed_normals_round_a_sphere_and_keep_a_box_sharp():
    sphere = white(trimesh.creation.icosphere(subdivisions=3))
    corners = sphere.vertices_m[sphere.faces]
    assert np.einsum("fck,fck->fc", smoothed_normals(sphere), corners).min() > 0.999
    box = white(trimesh.creation.box((1, 1, 1)))
    assert set(np.unique(np.abs(smoothed_normals(box)).round(6))) == {0.0, 1.0}


def test_fine_texture_averages_instead_of_flickering():
    """A black and white pattern of a fiftieth of a pixel is grey, in linear light."""
    board = Image.fromarray(np.kron(np.indices((64, 64)).sum(0) % 2, np.ones((1, 1))).astype(np.uint8) * 255)
    plate = trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 2, 1], [0, 3, 2]], process=False)
    uv = np.array([[0, 0], [20, 0], [20, 20], [0, 20]])
    material = PBRMaterial(baseColorTexture=board.convert("RGB"), metallicFactor=0.0)
    plate.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    target = target_from_scene(trimesh.Scene(plate), "board")
    radiance, coverage = render(target, [0, 0, -1])
    np.testing.assert_allclose(radiance[coverage == 1], 0.5, atol=0.01)
