"""Directions over the sphere, and cameras that look along them."""

import numpy as np
import pytest

from hat_ros.errors import UsageError
from hat_ros.geometry import lie
from hat_ros.target.sphere import (
    even_directions,
    icosphere,
    look_along,
    look_inwards,
    look_inwards_upright,
    upright_icosphere,
)


def nearest_deg(directions):
    """Angle (N,) from each direction to its nearest neighbour."""
    cosines = directions @ directions.T - 2 * np.eye(len(directions))
    return np.degrees(np.arccos(np.clip(cosines.max(axis=1), -1, 1)))


@pytest.mark.parametrize("n_vertices", [12, 42, 162, 642, 2562])
def test_an_icosphere_covers_the_sphere_evenly(n_vertices):
    vertices = icosphere(n_vertices)
    assert vertices.shape == (n_vertices, 3)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0, atol=1e-15)
    apart_deg = nearest_deg(vertices)
    assert apart_deg.max() < 1.4 * apart_deg.min()


@pytest.mark.parametrize("n_vertices", [0, 100, 163])
def test_other_sizes_are_refused(n_vertices):
    with pytest.raises(UsageError, match="162"):
        icosphere(n_vertices)


@pytest.mark.parametrize("n_vertices", [12, 42, 162])
def test_an_upright_icosphere_has_poles_and_is_sorted(n_vertices):
    vertices = upright_icosphere(n_vertices)
    np.testing.assert_allclose(vertices[[0, -1]], [[0, 0, -1], [0, 0, 1]], atol=1e-12)
    assert (np.diff(vertices[:, 2]) > -1e-6).all()
    # The published sets start from an icosahedron with a ring of five at z = 1 / sqrt(5), one of them above the x axis.
    ring = np.array([2.0, 0.0, 1.0]) / np.sqrt(5)
    assert np.linalg.norm(vertices - ring, axis=1).min() < 1e-12
    np.testing.assert_allclose(np.sort(nearest_deg(vertices)), np.sort(nearest_deg(icosphere(n_vertices))), atol=1e-5)


def test_any_number_of_even_directions():
    directions = even_directions(140)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(directions.mean(axis=0), 0.0, atol=0.01)
    assert nearest_deg(directions).min() > 0.5 * np.degrees(np.sqrt(4 * np.pi / 140))


def test_image_y_follows_the_direction_that_is_down():
    rng = np.random.default_rng(0)
    forward, down = rng.normal(size=(2, 20, 3))
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    R = look_along(forward, down)
    assert lie.is_rigid(lie.transform(R, np.zeros((20, 3)))).all()
    np.testing.assert_allclose(np.einsum("nij,nj->ni", R, forward), [[0, 0, 1]] * 20, atol=1e-12)
    seen = np.einsum("nij,nj->ni", R, down)
    np.testing.assert_allclose(seen[:, 0], 0.0, atol=1e-12)
    assert (seen[:, 1] > 0).all()


@pytest.mark.parametrize("look", [look_inwards, look_inwards_upright])
def test_cameras_look_at_the_middle_from_all_sides(look):
    R = look(162)
    assert lie.is_rigid(lie.transform(R, np.zeros((162, 3)))).all()
    assert nearest_deg(-R[:, 2]).max() < 1.4 * nearest_deg(-R[:, 2]).min()


def test_upright_cameras_show_the_z_axis_upwards():
    R = look_inwards_upright(162)
    z_axis = R[:, :, 2]  # in each camera
    at_pole = np.abs(R[:, 2, 2]) > 1 - 1e-6
    assert at_pole.sum() == 2
    np.testing.assert_allclose(z_axis[~at_pole, 0], 0.0, atol=1e-12)
    assert (z_axis[~at_pole, 1] < 0).all()
