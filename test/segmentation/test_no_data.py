"""Borders of exact zeros are no data, an ordinary black sky is left alone."""

import cv2
import numpy as np
import pytest
from segmentation_scene import HEIGHT, WIDTH, frame, overlap

from hat_ros.config import HatConfig
from hat_ros.segmentation.no_data import with_sky_in_borders
from hat_ros.segmentation.stage import SegmentationStage


def letterboxed(image, flags):
    out = np.zeros_like(image)
    out[60:-60] = image[60:-60]
    return out


def pillarboxed(image, flags):
    out = np.zeros_like(image)
    out[:, 5:-5] = image[:, 5:-5]
    return out


def circular(image, flags):
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    inside = np.hypot(u - WIDTH / 2, v - HEIGHT / 2) < 0.49 * HEIGHT
    return image * (inside[..., None] if image.ndim == 3 else inside).astype(image.dtype)


def rotated(image, flags):
    turn = cv2.getRotationMatrix2D((WIDTH / 2, HEIGHT / 2), 15.0, 0.9)
    return cv2.warpAffine(image, turn, (WIDTH, HEIGHT), flags=flags)


def rectified(image, flags):
    K = np.array([[0.8 * WIDTH, 0, WIDTH / 2], [0, 0.8 * WIDTH, HEIGHT / 2], [0, 0, 1.0]])
    new, _ = cv2.getOptimalNewCameraMatrix(K, np.array([-0.3, 0.05, 0, 0]), (WIDTH, HEIGHT), 1.0)
    maps = cv2.initUndistortRectifyMap(K, np.array([-0.3, 0.05, 0, 0]), None, new, (WIDTH, HEIGHT), cv2.CV_32FC1)
    return cv2.remap(image, *maps, flags)


BORDERS = (letterboxed, pillarboxed, circular, rotated, rectified)


@pytest.mark.parametrize("level", [3.0, 12.0])
@pytest.mark.parametrize("border", BORDERS)
def test_the_floor_of_the_sky_is_not_the_target(lopsided, scene, border, level):
    stage, T = SegmentationStage(HatConfig(), lopsided), scene.pose(0.3, z=9.0)
    image = border(scene.image(T, level=level, noise=1.0, stars=20), cv2.INTER_LINEAR)
    assert not image[0].any(axis=1).all() or not image[:, 0].any(axis=1).all(), "there is a border"
    truth = border(scene.truth(T).astype(np.uint8), cv2.INTER_NEAREST) > 0
    found = stage.update(frame(0, image), None)
    assert overlap(found.mask, truth) > 0.9


@pytest.mark.parametrize("border", BORDERS)
def test_pixels_with_data_stay_as_they_are(scene, border):
    image = border(scene.image(scene.pose(0.3, z=9.0), level=4.0, noise=1.0), cv2.INTER_LINEAR)
    out = with_sky_in_borders(image)
    assert np.array_equal(out, with_sky_in_borders(image)), "the same every time"
    changed = (out != image).any(axis=2)
    inside = cv2.erode(image.any(axis=2).astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=1) > 0
    assert changed.mean() > 0.01 and not (changed & inside).any()
    assert abs(out[changed].mean() - 4.0) < 0.5


@pytest.mark.parametrize("level", [0.0, 0.3, 1.0, 3.0, 14.0])
@pytest.mark.parametrize("noise", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("gain", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("z", [3.0, 6.0, 16.0])
def test_an_ordinary_sky_is_the_very_same_image(scene, level, noise, gain, z):
    image = scene.image(scene.pose(0.3, z=z), level=level, noise=noise, gain=gain, stars=30)
    assert with_sky_in_borders(image) is image


def test_a_flat_dim_target_before_a_sky_of_zeros_is_no_picture():
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    cv2.rectangle(image, (20, 20), (WIDTH - 20, HEIGHT - 20), (20, 20, 20), -1)
    assert with_sky_in_borders(image) is image
    assert with_sky_in_borders(np.zeros_like(image)).max() == 0
