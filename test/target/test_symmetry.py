"""Orientations that a silhouette cannot tell apart."""

import numpy as np
import pytest
import trimesh
from shape_scene import CAMERA, picture, pose_errors, random_pose, spacecraft

from hat_ros.config import HatConfig
from hat_ros.geometry import lie
from hat_ros.hypotheses.template import TemplateHypotheses
from hat_ros.target.loading import target_from_scene
from hat_ros.target.symmetry import load_or_find_symmetries, near_symmetries, turned
from hat_ros.types import Camera, Detection, PosePrior

HALF_TURN_Z = np.diag([-1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def winged():
    """A long box with two equal wings and, on one side only, a small bright box: half a turn about z hardly shows."""
    parts = [
        (trimesh.creation.box((0.5, 0.6, 1.6)), 200),
        (trimesh.creation.box((3.0, 0.04, 0.5), transform=lie.transform(np.eye(3), [0, 0, 0.5])), 90),
        (trimesh.creation.box((0.12, 0.12, 0.3), transform=lie.transform(np.eye(3), [0.31, 0, -0.4])), 250),
    ]
    for mesh, grey in parts:
        mesh.visual.face_colors = np.tile([grey, grey, grey, 255], (len(mesh.faces), 1))
    return target_from_scene(trimesh.Scene([mesh for mesh, _ in parts]), "winged")


def angles_deg(turns, turn):
    return np.degrees(lie.angle_between(turns, turn))


def test_a_box_has_its_half_turns():
    target = target_from_scene(trimesh.Scene([trimesh.creation.box((2.0, 1.0, 0.4))]), "box")
    turns = near_symmetries(target)
    assert len(turns) == 3
    for axis in range(3):
        half = -np.eye(3)
        half[axis, axis] = 1.0
        assert angles_deg(turns, half).min() < 1e-6


def test_a_box_that_lies_askew_in_its_file_has_them_too():
    askew = lie.transform(lie.so3_exp(np.array([0.3, 0.5, -0.2])), np.zeros(3))
    target = target_from_scene(trimesh.Scene([trimesh.creation.box((2.0, 1.0, 0.4), transform=askew)]), "askew")
    turns = near_symmetries(target)
    assert len(turns) == 3
    np.testing.assert_allclose(angles_deg(turns, np.eye(3)), 180, atol=1e-3)


def test_a_lopsided_body_has_none():
    assert near_symmetries(spacecraft()).shape == (0, 3, 3)


def test_a_small_part_on_one_side_does_not_break_a_symmetry(winged):
    turns = near_symmetries(winged)
    assert angles_deg(turns[:1], HALF_TURN_Z)[0] < 1.0


def test_what_is_stored_is_what_was_found(winged, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first, second = load_or_find_symmetries(winged), load_or_find_symmetries(winged)
    np.testing.assert_array_equal(first, near_symmetries(winged))
    np.testing.assert_array_equal(first, second)
    lopsided = spacecraft()
    assert load_or_find_symmetries(lopsided).shape == load_or_find_symmetries(lopsided).shape == (0, 3, 3)


def test_turning_leaves_the_centre_where_it_is(winged):
    T = random_pose(np.random.default_rng(0), winged)
    center = np.array([0.3, -0.2, 0.5])
    after = turned(T, HALF_TURN_Z, center)
    np.testing.assert_allclose(after[:3, :3] @ center + after[:3, 3], T[:3, :3] @ center + T[:3, 3])
    np.testing.assert_allclose(turned(after, HALF_TURN_Z, center), T, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_the_counterpart_of_a_prior_competes_even_where_the_search_finds_neither(winged, tmp_path, monkeypatch, seed):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    backend = TemplateHypotheses(HatConfig(), winged)
    monkeypatch.setattr(backend, "_coarse", lambda *_: [])
    monkeypatch.setattr(backend, "_coarse_lit", lambda *_: [])
    T_true = random_pose(np.random.default_rng(seed), winged)
    frame, mask = picture(winged, T_true)
    mirrored = lie.row_from_matrix(turned(T_true, HALF_TURN_Z, winged.center_m))
    prior = PosePrior(0, mirrored, mirrored, healthy=True, supported=True)
    turn, _ = pose_errors(backend.generate(frame, Detection(mask), prior).T_cam_target, T_true)
    assert turn.min() < 3
    assert turn.max() > 170


def test_a_thin_antenna_tells_two_orientations_clearly_apart(tmp_path, monkeypatch):
    """At the resolution that tells basins apart it is lost between the rays, or several times too thick."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    body = trimesh.creation.box((0.5, 0.6, 1.6))
    wings = trimesh.creation.box((3.0, 0.04, 0.5), transform=lie.transform(np.eye(3), [0, 0, 0.5]))
    rod = trimesh.creation.cylinder(0.012, 0.7, transform=lie.transform(np.eye(3), [0.2, 0.25, -1.15]))
    target = target_from_scene(trimesh.Scene([body, wings, rod]), "rod")
    camera = Camera(CAMERA.K * np.array([[2.0, 1, 2], [1, 2.0, 2], [1, 1, 1]]), 2 * CAMERA.width, 2 * CAMERA.height)
    backend = TemplateHypotheses(HatConfig(), target)
    leads = []
    for seed in (0, 7, 9, 10):  # views in which nothing hides it
        T_true = random_pose(np.random.default_rng(seed), target)
        frame, mask = picture(target, T_true, camera, background=200)
        mirrored = lie.row_from_matrix(turned(T_true, HALF_TURN_Z, target.center_m))
        prior = PosePrior(0, mirrored, mirrored, healthy=False, supported=True)
        candidates = backend.generate(frame, Detection(mask), prior)
        turn, _ = pose_errors(candidates.T_cam_target, T_true)
        leads.append(candidates.log_score[turn < 5].max() - candidates.log_score[turn > 175].max())
    assert min(leads) > 0
    assert np.mean(leads) > 3.8
