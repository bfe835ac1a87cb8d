import cv2
import numpy as np
import pytest
from segmentation_scene import frame, overlap

from hat_ros.config import HatConfig
from hat_ros.segmentation.masks import Window
from hat_ros.segmentation.outlines import SharpOutlines, is_grey
from hat_ros.segmentation.stage import SegmentationStage

SIZE = (144, 108)


def grey(rgb):
    return np.repeat(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)


def reduced(mask):
    return (cv2.resize(255 * mask.astype(np.uint8), SIZE, interpolation=cv2.INTER_AREA) > 127).astype(np.uint8)


def before_clouds(scene, i):
    """Without colour the body would be as grey as the ground of the scene; clouds are brighter."""
    _, image, truth = scene.passing(i)
    return grey(np.where(truth[..., None], image, 150 + image // 4)), truth


@pytest.fixture
def outlines_at(scene):
    def at(i):
        image, truth = before_clouds(scene, i)
        picture = Window.whole(image, 320).rgb
        return SharpOutlines(np.ascontiguousarray(picture[..., 0]), SIZE), reduced(truth)

    return at


def test_a_picture_of_a_monochrome_camera_is_grey(scene):
    image = scene.image(scene.pose(0.3))
    assert is_grey(grey(image)) and not is_grey(image)
    assert is_grey(np.zeros((4, 6, 3), np.uint8))


@pytest.mark.parametrize("i", range(4, 14, 3))
def test_the_target_is_among_what_lies_between_sharp_outlines(outlines_at, i):
    outlines, truth = outlines_at(i)
    assert max(overlap(cut > 0, truth > 0) for cut in outlines.cuts()) > 0.8


@pytest.mark.parametrize("i", range(4, 14, 3))
def test_the_target_holds_more_of_them_than_the_ground(outlines_at, i):
    outlines, truth = outlines_at(i)
    everything = np.ones_like(truth)
    held = outlines.held_beyond_chance(truth)
    assert held > 0.6
    assert held > outlines.held_beyond_chance(cv2.flip(truth, -1)) + 0.3
    assert abs(outlines.held_beyond_chance(everything)) < 1e-9


@pytest.mark.parametrize("level", [0, 90, 255])
def test_where_nothing_is_sharp_nothing_is_said(level):
    outlines = SharpOutlines(np.full((240, 320), level, np.uint8), SIZE)
    assert outlines.cuts() == []
    assert outlines.held_beyond_chance(np.ones((108, 144), np.uint8)) is None


def test_noise_has_no_outlines():
    noise = np.clip(np.random.default_rng(0).normal(90, 2, (240, 320)), 0, 255).astype(np.uint8)
    assert SharpOutlines(noise, SIZE).cuts() == []


def test_a_target_without_colour_is_found_before_textured_ground(lopsided, scene):
    stage = SegmentationStage(HatConfig(), lopsided)
    found = []
    for i in range(4, 14):
        image, truth = before_clouds(scene, i)
        detection = stage.update(frame(i, image), None)
        found.append(0.0 if detection is None else overlap(detection.mask, truth))
    assert np.median(found) > 0.8
