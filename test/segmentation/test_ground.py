import cv2
import numpy as np
import pytest
from segmentation_scene import HEIGHT, WIDTH, frame, overlap

from hat_ros.config import HatConfig
from hat_ros.segmentation.ground import GroundMemory
from hat_ros.segmentation.masks import Window
from hat_ros.segmentation.region import tidy
from hat_ros.segmentation.search import Search
from hat_ros.segmentation.shape import SilhouetteBank
from hat_ros.segmentation.stage import SegmentationStage
from hat_ros.target.ray_renderer import RayRenderer

BOX = np.s_[90:150, 130:200]  # where the body stands
LENGTH_PX = 70.0
COLOR = (170, 130, 150)  # as bright as the ground


def truth():
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[BOX] = 1
    return mask


def picture(scene, H_image_ground, body=True, seed=0):
    """The ground seen through a homography, a plain body before it, sensor noise."""
    rgb = cv2.warpPerspective(scene.ground, H_image_ground, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
    if body:
        rgb[BOX] = COLOR
    return np.clip(rgb + np.random.default_rng(seed).normal(size=rgb.shape) * 1.5, 0, 255).astype(np.uint8)


def shifted(i, step=8.0):
    return np.array([[1.0, 0, -20 - step * i], [0, 1.0, -60 - 0.3 * step * i], [0, 0, 1.0]])


def turned(i):
    """A view that shifts, turns and tilts."""
    a = 0.01 * i
    return np.array([[np.cos(a), -np.sin(a), -30 - 8 * i], [np.sin(a), np.cos(a), -60], [2e-5 * i, 0, 1.0]])


def remembered(scene, view, frames, mask=None, body=True):
    memory = GroundMemory()
    for i in range(frames):
        rgb = picture(scene, view(i), body, seed=i)
        memory.push(rgb, mask if i else None)
    return memory, Window.whole(rgb, 160)


@pytest.mark.parametrize("view", [shifted, turned])
@pytest.mark.parametrize("told", [False, True])
def test_what_stands_before_the_ground_is_found(scene, view, told):
    memory, window = remembered(scene, view, 18, truth() if told else None)
    seen = memory.evidence(window, LENGTH_PX)
    body = window.reduce(truth())
    assert overlap(tidy(seen.target, None), body) > 0.9
    if told:  # otherwise the ground that the body has uncovered looks strange as well
        assert overlap(seen.target, body) > 0.9
    assert not (seen.ground & cv2.erode(body, np.ones((5, 5), np.uint8))).mean() > 0.01


def test_it_confirms_the_right_mask_and_contradicts_another(scene):
    memory, window = remembered(scene, shifted, 18, truth())
    seen = memory.evidence(window, LENGTH_PX)
    body = window.reduce(truth())
    half = body.copy()
    half[:, : window.rgb.shape[1] // 2] = 0
    elsewhere = np.roll(body, -40, axis=0)
    assert seen.confirms(body)
    assert not seen.contradicts(body)
    assert not seen.confirms(half)
    assert not seen.confirms(elsewhere)
    assert seen.contradicts(elsewhere)


def test_ground_that_stands_still_tells_nothing(scene):
    memory, window = remembered(scene, lambda i: shifted(0), 12)
    assert memory.length_known_px(window) < 1
    assert memory.evidence(window, LENGTH_PX) is None


def test_only_ground_is_no_target(scene):
    memory, window = remembered(scene, shifted, 18, body=False)
    seen = memory.evidence(window, LENGTH_PX)
    assert seen.known.mean() > 0.5
    assert seen.target.mean() < 0.001
    assert seen.ground.sum() > 0.6 * seen.known.sum()


def test_another_scene_is_a_new_start(scene):
    memory, window = remembered(scene, shifted, 18)
    assert memory.length_known_px(window) > LENGTH_PX
    memory.push(np.ascontiguousarray(picture(scene, shifted(0))[::-1, ::-1]), None)
    assert memory.length_known_px(window) == 0
    memory.push(np.zeros((40, 30, 3), np.uint8), None)  # of another size
    assert memory.length_known_px(window) == 0


def test_a_target_longer_than_the_ground_has_moved_is_not_taken_for_found(lopsided, scene):
    search = Search(HatConfig().segmentation.classical, SilhouetteBank(lopsided, RayRenderer(lopsided)))
    for i in range(5):
        rgb = picture(scene, shifted(i), seed=i)
        search.push(rgb)
    assert search.before_ground(rgb) is None


def test_a_mask_that_lacks_a_part_gets_it_back(lopsided, scene):
    """The wing's colour is learned as background; that it stands before the ground says otherwise."""
    stage = SegmentationStage(HatConfig(), lopsided)
    T = scene.pose(0.3, z=9.0)
    body = scene.truth(T)
    lacking = body.copy()
    columns = np.flatnonzero(body.any(axis=0))
    lacking[:, int(columns[0] + 0.6 * np.ptp(columns)) :] = False
    for i in range(24):
        rgb = scene.image(T, ground_shift=3 * i, seed=i)
        found = stage.update(frame(i, rgb), None)
        if i == 12:
            stage._backend._masks = (lacking.astype(np.uint8), lacking.astype(np.uint8))
    assert overlap(found.mask, body) > 0.9
