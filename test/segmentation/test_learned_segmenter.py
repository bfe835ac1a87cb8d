from dataclasses import replace

import cv2
import numpy as np
import pytest
from segmentation_scene import HEIGHT, WIDTH, frame, overlap, prior

from hat_ros.config import HatConfig
from hat_ros.segmentation.learned import LearnedSegmenter, Window

SIZE = (WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def segmenter(lopsided):
    return LearnedSegmenter(HatConfig(), lopsided)


@pytest.fixture(autouse=True)
def fresh(segmenter):
    segmenter.reset()


def found(segmenter, index, rgb, expected=None):
    detection = segmenter.update(frame(index, rgb), expected)
    return np.zeros((HEIGHT, WIDTH), bool) if detection is None else detection.mask


@pytest.mark.parametrize("ground_shift", [None, 20])
def test_a_search_from_nothing_finds_the_target(segmenter, scene, ground_shift):
    T = scene.pose()
    rgb = scene.image(T, ground_shift=ground_shift)
    assert overlap(found(segmenter, 0, rgb), scene.truth(T)) > 0.85


def test_grey_images_are_no_different(segmenter, scene):
    T = scene.pose()
    grey = cv2.cvtColor(scene.image(T), cv2.COLOR_RGB2GRAY)
    assert overlap(found(segmenter, 0, np.repeat(grey[..., None], 3, axis=2)), scene.truth(T)) > 0.85


def test_a_tracked_target_is_found_with_its_predicted_silhouette(segmenter, scene):
    for i in range(4):
        T, rgb, truth = scene.passing(i)
        expected = prior(T @ scene.pose(0.02, z=0.02) @ np.linalg.inv(scene.pose(z=0.0)))
        assert overlap(found(segmenter, i, rgb, expected), truth) > 0.85


def test_without_a_prior_the_previous_mask_leads_on(segmenter, scene):
    masks = [found(segmenter, i, scene.passing(i)[1]) for i in range(4)]
    assert all(overlap(mask, scene.passing(i)[2]) > 0.8 for i, mask in enumerate(masks))


def test_a_wrong_prior_does_not_hide_the_target(segmenter, scene):
    T = scene.pose()
    elsewhere = prior(scene.pose(2.0, x=-1.2, y=0.8))
    assert overlap(found(segmenter, 0, scene.image(T, ground_shift=20), elsewhere), scene.truth(T)) > 0.8


def test_a_prior_out_of_sight_is_no_prior(segmenter, scene):
    T = scene.pose()
    rgb = scene.image(T, ground_shift=20)
    alone = found(segmenter, 0, rgb)
    segmenter.reset()
    np.testing.assert_array_equal(found(segmenter, 0, rgb, prior(scene.pose(x=40.0))), alone)
    segmenter.reset()
    lost = replace(prior(T), pose_row=np.full(7, np.nan))
    np.testing.assert_array_equal(found(segmenter, 0, rgb, lost), alone)


def test_an_empty_sky_holds_nothing(segmenter):
    rng = np.random.default_rng(3)
    sky = np.clip(rng.normal(3, 2, (HEIGHT, WIDTH, 1)) + np.zeros(3), 0, 255).astype(np.uint8)
    for x, y in zip(rng.integers(WIDTH, size=20), rng.integers(HEIGHT, size=20), strict=True):
        sky[y, x] = 220
    assert segmenter.update(frame(0, sky), None) is None


def test_bare_ground_holds_nothing(segmenter, scene):
    ground = np.clip(scene.ground[:HEIGHT, :WIDTH], 0, 255).astype(np.uint8)
    assert segmenter.update(frame(0, ground), None) is None


def test_a_reset_forgets_the_previous_mask(segmenter, scene):
    rgb = scene.passing(0)[1]
    first = found(segmenter, 0, rgb)
    found(segmenter, 1, scene.passing(1)[1])
    segmenter.reset()
    np.testing.assert_array_equal(found(segmenter, 2, rgb), first)


def test_a_window_shows_its_box_in_the_middle_and_gives_its_pixels_back():
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    x0, y0, x1, y1 = 150, 60, 250, 140
    rgb[y0:y1, x0:x1] = 200
    window = Window.around(rgb, (x0, y0, x1, y1), 192, 0.65)
    assert all(side % 32 == 0 for side in window.rgb.shape[:2])
    assert max(window.rgb.shape[:2]) == 192
    log_odds = window.rgb[..., 0].astype(np.float32) - 100
    inside = window.in_image(log_odds, SIZE)
    np.testing.assert_array_equal(inside > 0, rgb[..., 0] > 0)
    rows, columns = np.nonzero(log_odds > 0)
    assert np.ptp(columns) + 1 == pytest.approx(0.65 * 192, abs=1.5)
    assert columns.mean() == pytest.approx((window.rgb.shape[1] - 1) / 2, abs=0.6)
    assert rows.mean() == pytest.approx((window.rgb.shape[0] - 1) / 2, abs=0.6)


@pytest.mark.parametrize("box", [(0, 0, 40, 30), (280, 200, 320, 240), (-60, -40, 700, 500)])
def test_a_window_may_reach_beyond_the_image(box):
    rgb = np.full((HEIGHT, WIDTH, 3), 180, np.uint8)
    window = Window.around(rgb, box, 192, 0.65)
    assert (window.rgb == 0).any()
    back = window.in_image(window.rgb[..., 0].astype(np.float32) - 100, SIZE)
    assert back.shape == (HEIGHT, WIDTH)
    assert back[5, 5] == (box[0] <= 0)


def test_the_prior_of_a_window_is_the_share_of_each_cell_inside_the_mask():
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[60:140, 150:250] = 1
    window = Window.around(rgb, (150, 60, 250, 140), 192, 0.65)
    cells = window.prior(mask)
    assert cells.shape == (window.rgb.shape[0] // 2, window.rgb.shape[1] // 2)
    assert 0 <= cells.min() <= cells.max() <= 1
    assert cells.sum() == pytest.approx(mask.sum() * (window.scale / 2) ** 2, rel=0.03)


def test_equal_inputs_give_equal_bytes(lopsided, segmenter, scene):
    other = LearnedSegmenter(HatConfig(), lopsided)
    for i in range(3):
        rgb = scene.passing(i)[1]
        np.testing.assert_array_equal(found(segmenter, i, rgb), found(other, i, rgb))


def test_a_mask_that_sharpening_removes_is_no_mask(segmenter, scene, monkeypatch):
    """A speck before noise: the frame after it found an empty mask to move on from, and divided by its area."""
    monkeypatch.setattr("hat_ros.segmentation.learned.refine_outline", lambda rgb, mask, band, contrast: 0 * mask)
    for i in range(3):
        assert segmenter.update(frame(i, scene.passing(i)[1]), None) is None
