from dataclasses import replace

import cv2
import numpy as np
import pytest
from shape_scene import CAMERA, picture, pose_errors, random_pose, spacecraft, sunlit_picture

from hat_ros.config import HatConfig, HypothesesConfig, TemplateConfig
from hat_ros.errors import ConfigError
from hat_ros.geometry import lie
from hat_ros.hypotheses import template
from hat_ros.hypotheses.matching import match_shape
from hat_ros.hypotheses.stage import HypothesisStage
from hat_ros.hypotheses.template import TemplateHypotheses
from hat_ros.refinement.mask_field import MaskField
from hat_ros.refinement.view import TargetViewer, contour_lines
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.types import Camera, Detection, Frame, PosePrior


@pytest.fixture(scope="module")
def target():
    return spacecraft()


@pytest.fixture(scope="module")
def backend(target, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield TemplateHypotheses(HatConfig(), target)


@pytest.mark.parametrize("seed", range(6))
def test_a_rendered_view_is_found_again_from_any_angle(backend, target, seed):
    T_true = random_pose(np.random.default_rng(seed), target)
    frame, mask = picture(target, T_true)
    candidates = backend.generate(frame, Detection(mask), None)
    assert 1 <= len(candidates) <= 10
    turn, shift = pose_errors(candidates.T_cam_target, T_true)
    assert turn[0] < 1.5
    assert shift[0] < 0.01
    assert (np.diff(candidates.log_score) <= 0).all()


@pytest.mark.parametrize("seed", range(5))
def test_a_view_with_half_its_silhouette_in_shadow_is_found_again(backend, target, seed):
    T_true = random_pose(np.random.default_rng(seed), target)
    frame, mask = sunlit_picture(target, T_true, (-1.0, 0.4, -0.1))
    lit = mask & (frame.rgb.max(axis=2) > 16)
    assert np.count_nonzero(lit) < 0.8 * np.count_nonzero(mask)
    candidates = backend.generate(frame, Detection(lit), None)
    turn, shift = pose_errors(candidates.T_cam_target, T_true)
    assert turn[0] < 8
    assert shift[0] < 0.05


@pytest.mark.parametrize("seed", range(5))
def test_stray_light_around_it_does_not_hide_that_a_target_is_half_in_shadow(backend, target, seed):
    T_true = random_pose(np.random.default_rng(seed), target)
    frame, mask = sunlit_picture(target, T_true, (-1.0, 0.4, -0.1))
    lit = mask & (frame.rgb.max(axis=2) > 16)
    x, y = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    u, v = CAMERA.project(T_true[:3, 3])
    glow = 110.0 * np.exp(-np.hypot(x - u, y - v) / 60.0)
    assert np.median(glow[cv2.dilate(mask.astype(np.uint8), np.ones((25, 25))) > mask]) > 32
    glaring = replace(frame, rgb=np.minimum(frame.rgb + glow[..., None], 255).astype(np.uint8))
    candidates = backend.generate(glaring, Detection(lit), None)
    turn, shift = pose_errors(candidates.T_cam_target, T_true)
    assert turn[0] < 8
    assert shift[0] < 0.08


@pytest.mark.parametrize("seed", range(4))
def test_light_tells_orientations_of_one_silhouette_apart(backend, target, seed):
    """Seen from opposite sides a distant body has mirrored outlines, and all but symmetric ones are alike."""
    T_true = random_pose(np.random.default_rng(seed), target, range_m=(20.0, 24.0))
    camera = Camera(CAMERA.K * np.array([[3.0, 1, 1], [1, 3.0, 1], [1, 1, 1]]), CAMERA.width, CAMERA.height)
    T_true[:2, 3] = 0.0
    frame, mask = sunlit_picture(target, T_true, (0.3, -0.4, -1.0), camera=camera)
    turn, _ = pose_errors(backend.generate(frame, Detection(mask), None).T_cam_target, T_true)
    assert turn[0] < 8


def test_candidates_are_distinct_basins(backend, target):
    frame, mask = picture(target, random_pose(np.random.default_rng(11), target))
    R = backend.generate(frame, Detection(mask), None).T_cam_target[:, :3, :3]
    angles = np.degrees(lie.angle_between(R[:, None], R[None]))[np.triu_indices(len(R), 1)]
    assert len(R) > 3
    assert np.median(angles) > 15


def test_the_search_goes_on_only_where_no_candidate_leads_clearly(backend, target, monkeypatch):
    counts = []

    def spy(*args):
        counts.append(args[4])
        return match_shape(*args)

    monkeypatch.setattr(template, "match_shape", spy)
    frame, mask = picture(target, random_pose(np.random.default_rng(3), target), background=120)
    scores = backend.generate(frame, Detection(mask), None).log_score
    assert scores[0] - scores[1] >= template._CLEAR_LEAD
    assert len(counts) == 1
    disc = cv2.circle(np.zeros(mask.shape, np.uint8), (CAMERA.width // 2, CAMERA.height // 2), 40, 1, -1) > 0
    backend.generate(frame, Detection(disc), None)
    assert counts[-1] > counts[0]


def test_a_mask_two_pixels_too_large_costs_neither_basin_nor_range(backend, target):
    T_true = random_pose(np.random.default_rng(3), target)
    frame, mask = picture(target, T_true)
    large = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    turn, shift = pose_errors(backend.generate(frame, Detection(large), None).T_cam_target, T_true)
    assert turn[0] < 3
    assert shift[0] < 0.02


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_a_target_cut_by_the_border_is_among_the_candidates(backend, target, seed):
    rng = np.random.default_rng(seed)
    T_true = random_pose(rng, target, range_m=(5.0, 5.5))
    T_true[0, 3] += 1.35
    frame, mask = picture(target, T_true)
    assert Detection(mask).touches_border()
    turn, shift = pose_errors(backend.generate(frame, Detection(mask), None).T_cam_target, T_true)
    best = np.argmin(turn)
    assert turn[best] < 10
    assert shift[best] < 0.1


def test_a_box_gives_the_truth_among_the_candidates(backend, target):
    T_true = random_pose(np.random.default_rng(4), target)
    frame, mask = picture(target, T_true)
    box = np.zeros_like(mask)
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    box[rows[0] - 3 : rows[-1] + 4, cols[0] - 3 : cols[-1] + 4] = True
    turn, _ = pose_errors(backend.generate(frame, Detection(box, silhouette=False), None).T_cam_target, T_true)
    assert turn.min() < 10


def test_a_healthy_prior_is_a_candidate(backend, target):
    T_true = random_pose(np.random.default_rng(8), target)
    frame, mask = picture(target, T_true)
    row = lie.row_from_matrix(T_true)
    prior = PosePrior(0, row, row, healthy=True, supported=True)
    turn, _ = pose_errors(backend.generate(frame, Detection(mask), prior).T_cam_target, T_true)
    assert turn.min() < 1


def test_an_unhealthy_prior_competes_in_full_light_and_in_part(backend, target, monkeypatch):
    T_true = random_pose(np.random.default_rng(2), target)
    monkeypatch.setattr(backend, "_coarse", lambda *_: [])
    monkeypatch.setattr(backend, "_coarse_lit", lambda *_: [])
    row = lie.row_from_matrix(T_true)
    prior = PosePrior(0, row, row, healthy=False, supported=False)
    frame, mask = sunlit_picture(target, T_true, (-1.0, 0.4, -0.1))
    for seen in (mask, mask & (frame.rgb.max(axis=2) > 16)):
        assert len(backend.generate(frame, Detection(seen), None)) == 0
        turn, _ = pose_errors(backend.generate(frame, Detection(seen), prior).T_cam_target, T_true)
        assert turn.min() < 3


@pytest.mark.parametrize("level", [0, 255])
def test_a_blank_image_with_a_box_gives_nothing(backend, level):
    frame = Frame(1, np.full((CAMERA.height, CAMERA.width, 3), level, np.uint8), CAMERA)
    box = np.zeros((CAMERA.height, CAMERA.width), bool)
    box[60:180, 80:240] = True
    assert len(backend.generate(frame, Detection(box, silhouette=False), None)) == 0


def test_a_mask_of_one_pixel_is_no_error(backend):
    frame = Frame(1, np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8), CAMERA)
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    mask[100, 100] = True
    assert np.isfinite(backend.generate(frame, Detection(mask), None).pose_rows).all()


def test_the_same_image_gives_the_same_bytes(backend, target, tmp_path, monkeypatch):
    frame, mask = picture(target, random_pose(np.random.default_rng(9), target))
    first = backend.generate(frame, Detection(mask), None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    second = TemplateHypotheses(HatConfig(), target).generate(frame, Detection(mask), None)
    assert first.pose_rows.tobytes() == second.pose_rows.tobytes()
    assert first.log_score.tobytes() == second.log_score.tobytes()


def test_the_stage_asks_at_keyframes_only(target, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    config = HatConfig(hypotheses=HypothesesConfig(max_candidates=3, template=TemplateConfig(n_views=162, n_coarse=6)))
    stage = HypothesisStage(config, target)
    frame, mask = picture(target, random_pose(np.random.default_rng(1), target))
    assert len(stage.update(frame, None, None)) == 0
    assert 1 <= len(stage.update(frame, Detection(mask), None)) <= 3
    assert len(stage.update(frame, Detection(mask), None)) == 0
    stage.reset()
    assert len(stage.update(frame, Detection(mask), None)) >= 1


@pytest.mark.parametrize("options", [{"n_views": 500}, {"n_angles": 71}])
def test_impossible_banks_are_refused(target, options):
    with pytest.raises(ConfigError, match=next(iter(options))):
        TemplateHypotheses(HatConfig(hypotheses=HypothesesConfig(template=TemplateConfig(**options))), target)


def test_a_contour_on_the_outline_is_nearer_to_it_than_one_beside(target):
    viewer = TargetViewer(target)
    T = random_pose(np.random.default_rng(0), target)
    view = viewer.view(T, CAMERA, 160)
    points_m = contour_lines(view, 96).points_m
    field = MaskField(RayRenderer(target).render(T, CAMERA, color=False).mask)
    beside, gone = T.copy(), T.copy()
    beside[0, 3] += 0.05 * T[2, 3]
    gone[0, 3] += 10.0 * T[2, 3]
    distances = [template._outline_distance_px(pose, points_m, CAMERA, field) for pose in (T, beside, gone)]
    assert distances[0] < 1.0 < distances[1] < distances[2] <= 0.1 * field.size_px + 1e-6
