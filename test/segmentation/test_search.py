import cv2
import numpy as np
import pytest
from segmentation_scene import HEIGHT, WIDTH

from hat_ros.config import HatConfig
from hat_ros.segmentation.search import Search
from hat_ros.segmentation.shape import SilhouetteBank
from hat_ros.target.ray_renderer import RayRenderer


@pytest.fixture
def search(lopsided):
    return Search(HatConfig().segmentation.classical, SilhouetteBank(lopsided, RayRenderer(lopsided)))


def checks(search, scene, mask_of, frames=range(3, 9)):
    """Whether single cuts confirm the mask that ``mask_of`` makes of the truth, frame by frame."""
    out = []
    for i in range(frames.stop):
        _, rgb, truth = scene.passing(i)
        search.push(rgb)
        if i in frames:
            out.append(search.confirms(mask_of(truth.astype(np.uint8))))
    return np.array(out)


def test_a_quick_check_confirms_the_right_mask(search, scene):
    assert checks(search, scene, lambda truth: truth).all()


def test_a_quick_check_confirms_no_other_mask(search, scene):
    elsewhere = cv2.circle(np.zeros((HEIGHT, WIDTH), np.uint8), (60, 60), 40, 1, -1)
    assert not checks(search, scene, lambda _: elsewhere).any()
    assert not checks(search, scene, lambda truth: np.roll(truth, 30, axis=1)).any()
    assert not checks(search, scene, lambda truth: np.zeros_like(truth)).any()


def test_a_quick_check_confirms_a_mask_that_the_border_cuts(search, scene):
    T = scene.pose(0.3, x=-1.9)
    truth = scene.truth(T).astype(np.uint8)
    assert truth[:, 0].any()
    search.push(scene.image(T, ground_shift=3))
    assert search.confirms(truth)


def test_the_outline_at_full_resolution_is_the_found_one(search, scene):
    _, rgb, truth = scene.passing(4)
    search.push(rgb)
    found = search.find(rgb, ())
    assert np.count_nonzero(found.mask & truth) / np.count_nonzero(found.mask | truth) > 0.9


def test_the_target_is_found_where_a_supported_pose_says_and_nowhere_else(search, scene):
    for i in range(5):
        _, rgb, truth = scene.passing(i)
        search.push(rgb)
    truth = truth.astype(np.uint8)
    found = search.around(rgb, truth)
    assert np.count_nonzero(found.mask & truth) / np.count_nonzero(found.mask | truth) > 0.9
    assert search.around(rgb, np.roll(truth, 90, axis=1)) is None


def test_before_the_ground_has_moved_a_mask_at_the_border_needs_more(search):
    inside = cv2.circle(np.zeros((HEIGHT, WIDTH), np.uint8), (100, 100), 40, 1, -1)
    at_border = cv2.circle(np.zeros((HEIGHT, WIDTH), np.uint8), (20, 100), 40, 1, -1)
    search.push(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert search.judge(at_border)[1] > search.judge(inside)[1] + 0.1
