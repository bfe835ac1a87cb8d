from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from hat_ros.render.network_views import NetworkViewRenderer, encode_normals
from hat_ros.target import target_from_scene

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(scope="module")
def recorded():
    return np.load(DATA / "megapose_views.npz")


@pytest.fixture(scope="module")
def renderer(recorded):
    mesh = trimesh.Trimesh(
        recorded["vertices"],
        recorded["faces"],
        vertex_normals=recorded["normals"],
        vertex_colors=recorded["colors_u8"],
        process=False,
    )
    return NetworkViewRenderer(target_from_scene(trimesh.Scene(mesh), "recorded"))


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


def test_normals_of_the_axes():
    axes = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1], [0.25, -0.25, -0.75]])
    coded = encode_normals(axes)
    # Zero and one lie on the seam of the table, half-way between its ends.
    assert np.abs(coded[0] - 123.5).max() < 1
    expected = 255 * (0.25 * 32 - 0.5) / 32
    np.testing.assert_allclose(coded[3], expected)


def test_target_behind_the_camera_is_black(renderer):
    T = np.eye(4)
    T[2, 3] = -5
    assert not renderer.render(T, np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]]), (320, 240)).any()
