"""The ray caster against analytic scenes, and the pixel convention."""

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from hat_ros.bench.synth.models import build_target
from hat_ros.geometry import lie
from hat_ros.target.loading import target_from_scene
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.rays import pixel_rays
from hat_ros.types import Camera

CAMERA = Camera(np.array([[200.0, 0.0, 63.0], [0.0, 210.0, 47.5], [0.0, 0.0, 1.0]]), 128, 96)


def scene_target(mesh):
    return target_from_scene(trimesh.Scene(mesh), "test")


def at(t, rotvec=(0, 0, 0)):
    return lie.transform(lie.so3_exp(np.array(rotvec, float)), np.array(t, float))


def test_depth_of_a_box_face_is_exact():
    view = RayRenderer(scene_target(trimesh.creation.box((1, 1, 1)))).render(at([0, 0, 4]), CAMERA)
    assert view.depth_m.dtype == np.float32 and view.face_id.dtype == np.int32 and view.rgb.dtype == np.uint8
    assert view.mask.any()
    np.testing.assert_allclose(view.depth_m[view.mask], 3.5, rtol=1e-6)
    np.testing.assert_allclose(view.normal_cam[view.mask], [[0, 0, -1]] * view.mask.sum(), atol=1e-6)
    assert (view.depth_m[~view.mask] == 0).all() and (view.normal_cam[~view.mask] == 0).all()


def test_depth_of_a_sphere_matches_the_analytic_one():
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    view = RayRenderer(scene_target(sphere)).render(at([0.2, -0.1, 5.0]), CAMERA)
    rays = pixel_rays(CAMERA, np.arange(128), np.arange(96))
    center = np.array([0.2, -0.1, 5.0])
    a, b = (rays * rays).sum(-1), rays @ center
    root = b * b - a * (center @ center - 1.0)
    inside = root > 0.05  # away from the limb, where the facets of the model matter
    depth = (b - np.sqrt(np.where(inside, root, 0))) / a
    assert view.mask[inside].all()
    np.testing.assert_allclose(view.depth_m[inside], depth[inside], atol=2e-3)
    normal = rays * depth[..., None] - center
    assert np.einsum("nk,nk->n", view.normal_cam[inside], normal[inside]).min() > 0.995


def test_pixel_centres_lie_at_integer_coordinates():
    """A plate whose edge projects to u = 60.5 covers pixel 61 and not 60; the same for rows."""
    plate = trimesh.Trimesh(
        [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], [[0, 1, 2], [0, 2, 3]], process=False
    )
    u_edge, v_edge, z = 60.5, 40.5, 2.0
    x = (u_edge - CAMERA.K[0, 2]) / CAMERA.K[0, 0] * z + 0.5
    y = (v_edge - CAMERA.K[1, 2]) / CAMERA.K[1, 1] * z + 0.5
    mask = RayRenderer(scene_target(plate)).render(at([x, y, z]), CAMERA).mask
    rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    assert cols[0] == 61 and rows[0] == 41
    np.testing.assert_allclose(CAMERA.project(np.array([x - 0.5, y - 0.5, z])), [u_edge, v_edge], atol=1e-9)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.integers(0, 10**6))
def test_the_silhouette_is_that_of_the_projected_triangles(seed):
    rng = np.random.default_rng(seed)
    target = build_target("probe")
    T = lie.transform(lie.so3_exp(rng.normal(size=3)), [*rng.uniform(-0.3, 0.3, 2), 8.0])
    mask = RayRenderer(target).render(T, CAMERA, color=False).mask
    corners = CAMERA.project(target.vertices_m @ T[:3, :3].T + T[:3, 3])[target.faces]  # (F, 3, 2)
    v, u = np.nonzero(cv2.dilate(mask.astype(np.uint8), np.ones((9, 9))))
    to_pixel = np.stack([u, v], axis=-1)[:, None, None] - corners  # (N, F, 3, 2)
    edge = np.roll(corners, -1, axis=1) - corners
    side = edge[..., 0] * to_pixel[..., 1] - edge[..., 1] * to_pixel[..., 0]
    clear = 1e-3  # px^2: what single precision may decide either way
    inside = ((side > clear).all(-1) | (side < -clear).all(-1)).any(-1)
    outside = ~((side > -clear).all(-1) | (side < clear).all(-1)).any(-1)
    assert mask[v[inside], u[inside]].all() and not mask[v[outside], u[outside]].any()
    assert (inside | outside).mean() > 0.97


def test_a_crop_renders_the_same_pixels():
    target, T = build_target("observer"), at([0.1, 0.2, 6.0], (0.4, 0.3, 0.1))
    renderer = RayRenderer(target)
    full, part = renderer.render(T, CAMERA), renderer.render(T, CAMERA.crop(40, 20, 50, 60))
    np.testing.assert_array_equal(part.face_id, full.face_id[20:80, 40:90])
    np.testing.assert_array_equal(part.rgb, full.rgb[20:80, 40:90])


def test_two_renderings_have_the_same_bytes():
    target, T = build_target("freighter"), at([0, 0, 9.0], (0.4, 1.3, 0.1))
    a, b = (RayRenderer(target).render(T, CAMERA) for _ in range(2))
    for name in ("depth_m", "normal_cam", "face_id", "rgb"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes()


def test_normals_face_the_camera_and_fit_the_faces():
    target, T = build_target("observer"), at([0, 0, 6.0], (1.0, 0.3, 0.1))
    view = RayRenderer(target).render(T, CAMERA)
    rays = pixel_rays(CAMERA, np.arange(128), np.arange(96))[view.mask]
    normals = view.normal_cam[view.mask]
    assert np.einsum("nk,nk->n", rays, normals).max() < 1e-3
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    corners = target.vertices_m[target.faces[view.face_id[view.mask]]] @ T[:3, :3].T
    assert np.abs(np.einsum("nk,nk->n", normals, corners[:, 1] - corners[:, 0])).max() < 1e-5


def test_colour_can_be_left_out():
    target, T = build_target("cubesat"), at([0, 0, 1.5])
    renderer = RayRenderer(target)
    with_color, without = renderer.render(T, CAMERA), renderer.render(T, CAMERA, color=False)
    assert with_color.rgb[with_color.mask].any() and not without.rgb.any()
    np.testing.assert_array_equal(with_color.face_id, without.face_id)


@pytest.mark.parametrize("t", [[0, 0, -5], [100, 0, 5], [0, -100, 5]])
def test_a_target_out_of_view_gives_an_empty_picture(t):
    view = RayRenderer(build_target("cubesat")).render(at(t), CAMERA)
    assert not view.mask.any() and not view.depth_m.any() and not view.rgb.any()


@pytest.mark.parametrize("t", [[0, 0, 5.0], [1.5, -0.5, 4.0], [0, 0, -5]])
def test_the_silhouette_alone_is_that_of_the_picture(t):
    renderer = RayRenderer(build_target("cubesat"))
    np.testing.assert_array_equal(renderer.silhouette(at(t), CAMERA), renderer.render(at(t), CAMERA).mask)


def test_a_camera_inside_the_model_sees_its_inner_walls():
    view = RayRenderer(scene_target(trimesh.creation.box((2, 2, 2)))).render(at([0, 0, 0]), CAMERA)
    assert view.mask.all() and view.depth_m.min() > 0.9


@pytest.mark.parametrize("t", [(0, 0, 4), (0.3, -0.2, 2.5), (1.3, 0.9, 3), (0, 0, 60)])
def test_a_quick_silhouette_is_the_silhouette_but_for_specks(t):
    body = trimesh.util.concatenate(
        [
            trimesh.creation.box((1, 0.7, 0.6)),
            trimesh.creation.box((0.6, 0.05, 0.4), lie.transform(np.eye(3), [0.8, 0, 0])),
        ]
    )
    renderer = RayRenderer(scene_target(body))
    for rotvec in ((0, 0, 0), (0.4, -0.8, 0.3), (1.5, 0.2, 2.0)):
        whole, quick = (cast(at(t, rotvec), CAMERA) for cast in (renderer.silhouette, renderer.quick_silhouette))
        assert quick.shape == whole.shape and quick.dtype == np.bool_
        assert not (quick & ~whole).any()
        assert np.count_nonzero(whole & ~quick) <= 0.02 * np.count_nonzero(whole)


def test_there_is_no_quick_silhouette_behind_the_camera():
    assert not RayRenderer(scene_target(trimesh.creation.box())).quick_silhouette(at((0, 0, -4)), CAMERA).any()
