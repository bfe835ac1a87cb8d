import numpy as np
import pytest
from segmentation_scene import HEIGHT, WIDTH, frame

from hat_ros.config import HatConfig, config_from_dict
from hat_ros.errors import FrameError
from hat_ros.segmentation.stage import SegmentationStage, is_black
from hat_ros.types import Detection


class Scripted:
    def __init__(self, detection):
        self.detection = detection
        self.resets = 0

    def update(self, frame, prior):
        return self.detection

    def reset(self):
        self.resets += 1


@pytest.fixture
def stage(lopsided):
    def build(detection):
        stage = SegmentationStage(config_from_dict({"segmentation": {"backend": "annotated"}}), lopsided)
        stage._backend = Scripted(detection)
        return stage

    return build


def grey():
    rgb = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    rgb[10:40, 10:60] = 200
    return rgb


def block(rows, cols):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:rows, :cols] = True
    return mask


def test_passes_on_a_good_mask(stage):
    detection = Detection(block(20, 20))
    assert stage(detection).update(frame(0, grey()), None) is detection


@pytest.mark.parametrize("mask", [block(2, 3), block(HEIGHT, WIDTH)], ids=["too small", "whole image"])
def test_rejects_degenerate_silhouettes(stage, mask):
    assert stage(Detection(mask)).update(frame(0, grey()), None) is None


def test_a_box_may_fill_the_image(stage):
    assert stage(Detection(block(HEIGHT, WIDTH), silhouette=False)).update(frame(0, grey()), None) is not None


@pytest.mark.parametrize("level", [0, 5, 255])
def test_an_image_without_contrast_is_not_even_looked_at(stage, level):
    rgb = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
    assert is_black(rgb)
    assert stage(Detection(block(20, 20))).update(frame(0, rgb), None) is None


@pytest.mark.parametrize("mask", [block(20, 20)[:-1], block(20, 20).astype(np.uint8)], ids=["size", "type"])
def test_a_malformed_mask_is_an_error_that_names_the_frame(stage, mask):
    with pytest.raises(FrameError, match="1000000000"):
        stage(Detection(mask)).update(frame(0, grey()), None)


def test_reset_reaches_the_backend(stage):
    built = stage(None)
    built.reset()
    assert built._backend.resets == 1


def test_the_default_backend_needs_no_weights(lopsided):
    assert type(SegmentationStage(HatConfig(), lopsided)._backend).__name__ == "ClassicalSegmenter"
