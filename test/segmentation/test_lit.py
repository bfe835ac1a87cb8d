import cv2
import numpy as np
import pytest
import trimesh

from hat_ros.config import ClassicalConfig
from hat_ros.segmentation.lit import LitBody
from hat_ros.segmentation.shape import SilhouetteBank
from hat_ros.segmentation.sky import lit_regions, measure_sky
from hat_ros.target.loading import target_from_scene
from hat_ros.target.ray_renderer import RayRenderer


def body_of(*boxes):
    """LitBody for a CAD model of boxes (size, centre)."""
    parts = []
    for size, center in boxes:
        part = trimesh.creation.box(size)
        part.apply_translation(center)
        part.visual.face_colors = (180, 180, 180, 255)
        parts.append(part)
    target = target_from_scene(trimesh.Scene(parts), "boxes")
    return LitBody(ClassicalConfig(), SilhouetteBank(target, RayRenderer(target)))


@pytest.fixture(scope="module")
def cabinet():
    return body_of(((1.0, 1.0, 2.0), (0, 0, 0)))


@pytest.fixture(scope="module")
def cross():
    return body_of(((2.0, 0.1, 0.1), (0, 0, 0)), ((0.1, 2.0, 0.1), (0, 0, 0)), ((0.1, 0.1, 2.0), (0, 0, 0)))


def find(body, shape):
    rgb = np.repeat((120 * shape)[..., None], 3, axis=2)
    rgb = np.clip(rgb + np.random.default_rng(0).normal(2, 1, shape.shape)[..., None], 0, 255).astype(np.uint8)
    measured = measure_sky(rgb)
    return body.find(measured, lit_regions(measured), None, None)


def overlap(a, b):
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


def test_a_body_of_which_stripes_are_lit_is_found_as_a_whole(cabinet):
    whole = np.zeros((240, 320), np.uint8)
    whole[40:200, 120:200] = 1
    lit = whole.copy()
    for y in range(44, 200, 12):
        lit[y : y + 9, 120:196] = 0
    assert overlap(lit, whole) < 0.5
    assert overlap(find(cabinet, lit), whole) > 0.9


def test_the_sky_between_the_arms_of_a_target_is_not_filled(cross):
    """What bridging makes of it is no shape that the CAD model can have."""
    lit = np.zeros((240, 320), np.uint8)
    cv2.line(lit, (60, 120), (260, 120), 1, 10)
    cv2.line(lit, (160, 20), (160, 220), 1, 10)
    lit[110:131, 150:171] = 0  # the middle is dark
    assert find(cross, lit).sum() < 1.2 * lit.sum()
