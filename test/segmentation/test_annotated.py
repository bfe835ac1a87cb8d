import numpy as np
import pytest
from segmentation_scene import HEIGHT, WIDTH, frame

from hat_ros.config import config_from_dict
from hat_ros.segmentation.annotated import AnnotatedSegmenter, pad_box


def segmenter(target, padding=0.0):
    return AnnotatedSegmenter(
        config_from_dict({"segmentation": {"backend": "annotated", "box_padding": padding}}), target
    )


def given(value, rows=slice(50, 100), cols=slice(40, 140)):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[rows, cols] = value
    return frame(0, np.zeros((HEIGHT, WIDTH, 3), np.uint8), mask)


def test_a_silhouette_is_passed_on_unchanged_whatever_the_padding(lopsided):
    detection = segmenter(lopsided, 0.3).update(given(255), None)
    assert detection.silhouette
    assert detection.box_xyxy.tolist() == [39.5, 49.5, 139.5, 99.5]


def test_a_box_is_no_silhouette(lopsided):
    detection = segmenter(lopsided).update(given(128), None)
    assert not detection.silhouette
    assert detection.box_xyxy.tolist() == [39.5, 49.5, 139.5, 99.5]


def test_a_box_is_padded_by_a_share_of_its_sides(lopsided):
    detection = segmenter(lopsided, 0.2).update(given(128), None)
    assert detection.box_xyxy.tolist() == [19.5, 39.5, 159.5, 109.5]


def test_padding_is_clipped_at_the_image(lopsided):
    box = segmenter(lopsided, 1.0).update(given(128, slice(0, 30), slice(WIDTH - 50, WIDTH)), None).box_xyxy
    assert box.tolist() == [WIDTH - 100 - 0.5, -0.5, WIDTH - 0.5, 59.5]


@pytest.mark.parametrize("value", [0, 1, 127])
def test_nothing_given_is_no_detection(lopsided, value):
    assert segmenter(lopsided).update(given(value), None) is None
    assert segmenter(lopsided).update(frame(0, np.zeros((HEIGHT, WIDTH, 3), np.uint8)), None) is None


def test_padding_never_shrinks_and_keeps_the_box_inside():
    rng = np.random.default_rng(0)
    for _ in range(50):
        y, x = rng.integers(0, 30), rng.integers(0, 50)
        h, w = rng.integers(1, 40 - y), rng.integers(1, 60 - x)
        box = np.zeros((40, 60), bool)
        box[y : y + h, x : x + w] = True
        assert pad_box(box, 0.0).sum() == h * w
        assert (pad_box(box, rng.uniform(0, 1)) >= box).all()
