import numpy as np
import pytest
from shape_scene import CAMERA, pose_errors, random_pose, spacecraft

from hat_ros.geometry import lie
from hat_ros.hypotheses.matching import cut_placements, distinct, match_shape, whole_placement
from hat_ros.target import view_bank
from hat_ros.target.ray_renderer import RayRenderer


@pytest.fixture(scope="module")
def scene():
    target = spacecraft()
    renderer = RayRenderer(target)
    return target, renderer, view_bank.build(target, renderer, 642, 72)


@pytest.mark.parametrize("seed", range(5))
def test_the_best_matches_hold_the_true_view(scene, seed):
    target, renderer, views = scene
    T_true = random_pose(np.random.default_rng(seed), target)
    mask = renderer.render(T_true, CAMERA, color=False).mask
    found = match_shape(views, mask, whole_placement(mask), CAMERA, 10, 15.0, target.center_m)
    turn, shift = pose_errors(found.T_cam_target, T_true)
    assert turn.min() < 12
    assert shift[np.argmin(turn)] < 0.1
    assert found.score.max() <= 1.0 + 1e-6


def test_a_mask_without_any_shape_is_matched_all_the_same(scene):
    target, _, views = scene
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    mask[50, 60] = True
    found = match_shape(views, mask, whole_placement(mask), CAMERA, 10, 15.0, target.center_m)
    assert len(found.view) > 0
    assert np.isfinite(found.T_cam_target).all()


def test_a_cut_mask_scores_what_lies_inside_only(scene):
    target, renderer, views = scene
    T_true = random_pose(np.random.default_rng(2), target, range_m=(5.0, 5.2))
    T_true[0, 3] += 1.3
    mask = renderer.render(T_true, CAMERA, color=False).mask
    assert mask[:, -1].any()
    found = match_shape(views, mask, cut_placements(mask), CAMERA, 24, 15.0, target.center_m)
    turn, _ = pose_errors(found.T_cam_target, T_true)
    assert turn.min() < 25


def test_distinct_keeps_order_and_separation():
    angles = np.radians([0.0, 3.0, 20.0, 22.0, 50.0])
    R = lie.so3_exp(angles[:, None] * np.array([0.0, 0.0, 1.0]))
    assert distinct(R, 10, np.radians(15.0)).tolist() == [0, 2, 4]
    assert distinct(R, 2, np.radians(15.0)).tolist() == [0, 2]
