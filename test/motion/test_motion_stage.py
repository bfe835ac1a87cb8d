"""The stage: what reaches the backend, and what happens without a mask."""

import numpy as np
import pytest
from speckled_clip import speckled_clip

import hat_ros.motion.stage as stage_module
from hat_ros.config import HatConfig, SlamConfig
from hat_ros.errors import ConfigError
from hat_ros.motion.feature import FeatureSlam
from hat_ros.motion.stage import MotionStage, suppress_background
from hat_ros.types import Motion


class Recorder:
    """A backend that keeps what it was given."""

    def __init__(self):
        self.seen = []
        self.epoch = 0

    def update(self, frame, detection, prior):
        self.seen.append((frame, detection, prior))
        return Motion.none(self.epoch)

    def reset(self):
        self.epoch += 1


@pytest.fixture(scope="module")
def clip():
    return speckled_clip(3, backdrop=True)


def staged(monkeypatch, masked):
    recorder = Recorder()
    monkeypatch.setattr(stage_module, "create_backend", lambda *_: recorder)
    return MotionStage(HatConfig(slam=SlamConfig(masked=masked)), None), recorder


def test_masked_frames_reach_the_backend_black_outside_the_mask(monkeypatch, clip):
    stage, recorder = staged(monkeypatch, masked=True)
    original = clip.frames[0].rgb.copy()
    stage.update(clip.frames[0], clip.detections[0], None)
    (frame, detection, _), mask = recorder.seen[0], clip.detections[0].mask
    assert detection is clip.detections[0]
    assert frame.stamp_ns == clip.frames[0].stamp_ns
    assert not frame.rgb[~mask].any()
    np.testing.assert_array_equal(frame.rgb[mask], original[mask])
    np.testing.assert_array_equal(clip.frames[0].rgb, original)


def test_no_mask_means_no_update_and_no_motion(monkeypatch, clip):
    stage, recorder = staged(monkeypatch, masked=True)
    motion = stage.update(clip.frames[0], None, None)
    assert not motion.valid
    assert not recorder.seen


def test_unmasked_frames_pass_untouched_even_without_a_detection(monkeypatch, clip):
    stage, recorder = staged(monkeypatch, masked=False)
    stage.update(clip.frames[0], None, None)
    assert recorder.seen[0][0] is clip.frames[0]


def test_frames_without_a_mask_carry_the_epoch_of_the_backend(monkeypatch, clip):
    stage, recorder = staged(monkeypatch, masked=True)
    recorder.epoch = 3
    stage.update(clip.frames[0], clip.detections[0], None)
    assert stage.update(clip.frames[1], None, None).epoch == 3


def test_the_configured_backend_is_built(clip):
    stage = MotionStage(HatConfig(), clip.target)
    assert isinstance(stage._backend, FeatureSlam)
    assert stage.update(clip.frames[0], clip.detections[0], None).valid
    stage.reset()
    assert stage.update(clip.frames[1], clip.detections[1], None).epoch == 1


def test_an_unknown_backend_is_named():
    with pytest.raises(ConfigError, match=r"slam\.backend.*'orb'"):
        MotionStage(HatConfig(slam=SlamConfig(backend="orb")), None)


def test_suppress_background_keeps_type_and_shape():
    rgb = np.full((4, 5, 3), 200, np.uint8)
    mask = np.zeros((4, 5), dtype=bool)
    mask[1, 2] = True
    out = suppress_background(rgb, mask)
    assert out.dtype == np.uint8
    assert out.sum() == 600
