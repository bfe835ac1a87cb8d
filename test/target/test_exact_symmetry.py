"""Exact symmetries of CAD models, in shape and colours."""

import numpy as np
import pytest
import trimesh
from shape_scene import spacecraft
from symmetric_bodies import body, colored

from hat_ros.errors import MeshError
from hat_ros.geometry import lie
from hat_ros.target.exact_symmetry import exact_symmetry, symmetry_of
from hat_ros.target.loading import load_target, target_from_scene
from hat_ros.target.symmetry import load_or_find_symmetries, near_symmetries

ASKEW = lie.transform(lie.so3_exp(np.array([0.3, 0.5, -0.2])), [0.1, 0.2, 0.3])


@pytest.mark.parametrize("place", [np.eye(4), ASKEW], ids=["along", "askew"])
@pytest.mark.parametrize(
    ("name", "order", "n_axes"),
    [("cube", 24, 0), ("box", 4, 0), ("prism", 8, 0), ("hexagon", 12, 0), ("rocket", 1, 1), ("drum", 2, 1)],
)
def test_the_group_of_a_body_is_found_however_it_lies_in_its_file(name, order, n_axes, place):
    found = exact_symmetry(body(name, place))
    assert (found.order, len(found.axes)) == (order, n_axes)
    if n_axes:
        np.testing.assert_allclose(np.abs(found.axes[0] @ place[:3, :3][:, 2]), 1, atol=1e-4)
    # All of it maps the surface onto itself.
    points = body(name, place).vertices_m
    for turn in found.turns:
        moved = points @ turn[:3, :3].T + turn[:3, 3]
        assert np.linalg.norm(moved[:, None] - points[None], axis=-1).min(axis=1).max() < 0.05


def test_a_ball_has_every_turn():
    ball = target_from_scene(trimesh.Scene([trimesh.creation.icosphere(3)]), "ball")
    assert len(exact_symmetry(ball).axes) == 3


def test_a_body_without_any_has_none():
    assert exact_symmetry(spacecraft()).is_trivial


def test_a_thin_rod_breaks_it_and_so_does_the_colour_of_a_face():
    rod = trimesh.creation.cylinder(0.01, 0.3, transform=lie.transform(np.eye(3), [0.3, 0.3, 0.65]))
    assert exact_symmetry(target_from_scene(trimesh.Scene([trimesh.creation.box((1, 1, 1)), rod]), "rod")).is_trivial
    faced = trimesh.creation.box((1, 1, 1))
    rgba = np.tile([170, 150, 90, 255], (12, 1))
    rgba[faced.face_normals[:, 0] > 0.9] = [90, 90, 200, 255]
    target = target_from_scene(trimesh.Scene([colored(faced, rgba)]), "faced")
    assert exact_symmetry(target).order == 4
    turns = near_symmetries(target, exact_symmetry(target))
    assert len(turns), "in shape alone it has more: these are near"
    assert (np.abs(turns[:, 0, 0]) < 0.9).all() or (turns[:, 0, 0] < 0).any()


def test_turns_that_are_exact_are_not_near_ones(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert load_or_find_symmetries(body("cube")).shape == (0, 3, 3)
    assert len(near_symmetries(body("cube"))) == 3


def test_what_is_stored_is_what_was_found(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    target = body("prism")
    first, second = symmetry_of(target), symmetry_of(target)
    np.testing.assert_array_equal(first.turns, second.turns)
    np.testing.assert_array_equal(first.turns, exact_symmetry(target).turns)


@pytest.fixture
def declared(tmp_path):
    def load(text):
        trimesh.creation.box((1, 1, 2)).export(tmp_path / "box.stl")
        (tmp_path / "target.yaml").write_text(f"mesh: box.stl\n{text}", encoding="utf-8")
        return load_target(tmp_path / "target.yaml")

    return load


def test_what_is_declared_counts_whatever_the_model_looks_like(declared):
    about_z = "symmetries_continuous: [{axis: [0, 0, 1], offset: [0, 0, 0]}]\n"
    assert len(symmetry_of(declared(about_z)).axes) == 1
    assert symmetry_of(declared("symmetries_discrete: []\n")).is_trivial
    quarter = "symmetries_discrete: [[0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]\n"
    assert symmetry_of(declared(quarter)).order == 4, "its products, too"


def test_a_wrong_declaration_is_one_sentence(declared):
    with pytest.raises(MeshError, match=r"target.yaml: symmetries_discrete\[0\] must be 16 finite numbers"):
        declared("symmetries_discrete: [[1, 0]]\n")
