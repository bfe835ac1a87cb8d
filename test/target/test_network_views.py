from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy import ndimage

from hat_ros.geometry import lie
from hat_ros.target import network_views
from hat_ros.target.loading import target_from_scene
from hat_ros.target.network_views import NetworkViewRenderer, encode_normal
from hat_ros.target.rays import pixel_rays, ray_caster
from hat_ros.types import Camera

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(scope="module")
def recorded():
    return np.load(DATA / "megapose_views.npz")


def renderer_target(recorded):
    mesh = trimesh.Trimesh(
        recorded["vertices"],
        recorded["faces"],
        vertex_normals=recorded["normals"],
        vertex_colors=recorded["colors_u8"],
        process=False,
    )
    return target_from_scene(trimesh.Scene(mesh), "recorded")


@pytest.fixture(scope="module")
def renderer(recorded):
    return NetworkViewRenderer(renderer_target(recorded))


@pytest.mark.parametrize("index", range(4))
def test_views_look_like_the_reference_renderer(recorded, renderer, index):
    view = renderer.render(recorded["TCO"][index], recorded["K"].astype(float), (320, 240)).astype(int)
    rgb, normals = recorded[f"rgb{index}"].astype(int), recorded[f"normals{index}"].astype(int)
    seen, mine = rgb.any(axis=2), view[..., :3].any(axis=2)
    outline = seen & ~ndimage.binary_erosion(seen)
    assert np.count_nonzero(seen != mine) < outline.sum()  # the silhouettes differ by under a pixel
    inner = ndimage.binary_erosion(seen & mine, iterations=2)
    assert np.percentile(np.abs(view[..., :3] - rgb)[inner], 99) <= 1
    error = np.abs(view[..., 3:] - normals)
    assert np.percentile(error[..., :2][inner], 95) <= 2
    # Its software rasteriser takes the nearest table entry for the third channel, so an exact zero jumps.
    at_the_seam = np.abs(view[..., 5] - 124) < 40
    third = np.where(at_the_seam, 0, error[..., 2])
    assert np.percentile(third[inner], 95) <= 8


def test_normal_colours():
    # Zero and one lie on the seam of the table, half-way between its ends.
    assert all(abs(encode_normal(value) - 123.5) < 1 for value in (0.0, 1.0, -1.0))
    assert encode_normal(0.25) == encode_normal(-0.75) == 255 * (0.25 * 32 - 0.5) / 32


def test_many_views_are_the_single_ones_whatever_the_number_of_threads(recorded, renderer):
    poses, K = recorded["TCO"][[0, 1, 2, 3, 0]], np.stack([recorded["K"].astype(float)] * 5)
    expected = [renderer.render(T, k, (96, 64)) for T, k in zip(poses, K, strict=True)]
    np.testing.assert_array_equal(renderer.render_many(poses, K, (96, 64)), expected)
    several = NetworkViewRenderer(renderer_target(recorded), n_threads=3)
    np.testing.assert_array_equal(several.render_many(poses, K, (96, 64)), expected)
    assert renderer.render_many(poses[:0], K[:0], (96, 64)).shape == (0, 64, 96, 6)


@pytest.mark.parametrize("seed", range(3))
def test_views_agree_with_ray_casting(seed):
    """Textured and vertex-coloured parts, seen through the samples' rays one by one."""
    rng = np.random.default_rng(seed)
    ball, box = trimesh.creation.icosphere(2, 0.4), trimesh.creation.box((1.0, 0.5, 0.3))
    ball.visual.vertex_colors = rng.integers(0, 256, (len(ball.vertices), 3), dtype=np.uint8)
    texture = Image.fromarray(rng.integers(0, 256, (5, 7, 3), dtype=np.uint8))
    box.visual = trimesh.visual.TextureVisuals(
        rng.uniform(-1.5, 1.5, (len(box.vertices), 2)), trimesh.visual.material.SimpleMaterial(texture)
    )
    ball.apply_translation([0.3, 0.4, 0.2])
    target = target_from_scene(trimesh.Scene([ball, box]), "two")
    T = lie.transform(lie.so3_exp(rng.normal(size=3)), np.array([0.1, -0.1, 2.5]))
    K = np.array([[90.0, 0, 40], [0, 95, 30], [0, 0, 1]])
    view = NetworkViewRenderer(target).render(T, K, (80, 60))
    rgb = np.zeros((60, 80, 3))
    for du, dv in network_views._SAMPLES:
        rays = pixel_rays(Camera(K, 80, 60), np.arange(80) + du, np.arange(60) + dv).reshape(-1, 3) @ T[:3, :3]
        hits = ray_caster(target).trace(np.broadcast_to(-T[:3, 3] @ T[:3, :3], rays.shape), rays)
        seen = hits.face >= 0
        hit = hits.taken(seen)
        rgb.reshape(-1, 3)[seen] += target.surface.sample(hit.face, hit.barycentric, target.face_rgb) / 4
    different = np.abs(view[..., :3] - rgb).max(axis=2) > 1.5
    assert view.any() and different.mean() < 2e-3, "only where a sample lies on an edge, of a face or a texel"


def test_a_target_around_the_camera_is_seen_from_inside():
    """Triangles that reach behind the camera need no clipping."""
    target = target_from_scene(trimesh.Scene(trimesh.creation.box((2.0, 2.0, 2.0))), "room")
    K = np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]])
    view = NetworkViewRenderer(target).render(np.eye(4), K, (32, 24))
    assert view[..., :3].any(axis=2).all()


def test_target_behind_the_camera_is_black(renderer):
    T = np.eye(4)
    T[2, 3] = -5
    assert not renderer.render(T, np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]]), (320, 240)).any()
