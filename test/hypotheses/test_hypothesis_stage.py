"""When the stage asks its backend, and on what."""

import numpy as np
import pytest

from hat_ros.config import HatConfig, KeyframeConfig, SegmentationConfig
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry, about_center
from hat_ros.hypotheses import stage as hypothesis_stage
from hat_ros.hypotheses.stage import HypothesisStage, box_overlap
from hat_ros.types import Camera, Candidates, Detection, Frame, PosePrior

CAMERA = Camera(np.array([[200.0, 0, 32], [0, 200.0, 32], [0, 0, 1]]), 64, 64)
DECIDED = Candidates(np.array([[0, 0, 5, 0, 0, 0, 1.0]]), np.zeros(1), np.array([8.0, 8, 40, 40]))


class _Backend:
    def generate(self, frame, detection, prior):
        return DECIDED

    def reset(self):
        pass


def _detection(left, right):
    mask = np.zeros((64, 64), np.bool_)
    mask[8:40, left:right] = True
    return Detection(mask)


def _asked(monkeypatch, detections, prior=None, symmetry=Symmetry()):  # noqa: B008
    monkeypatch.setattr(hypothesis_stage, "create_backend", lambda *_: _Backend())
    monkeypatch.setattr(hypothesis_stage, "symmetry_of", lambda target: symmetry)
    stage = HypothesisStage(HatConfig(keyframes=KeyframeConfig(gap_frames=6, settled_factor=3)), None)
    image = np.zeros((64, 64, 3), np.uint8)
    frames = [Frame(i + 1, image, CAMERA) for i in range(len(detections))]
    asked = [len(stage.update(f, d, prior)) > 0 for f, d in zip(frames, detections, strict=True)]
    return np.flatnonzero(asked).tolist()


def test_what_was_tried_on_a_part_of_the_target_is_tried_again_once_all_of_it_is_found(monkeypatch):
    part, whole = _detection(8, 20), _detection(8, 40)
    assert _asked(monkeypatch, [part] + 11 * [whole]) == [0, 2, 8]
    assert _asked(monkeypatch, 12 * [whole]) == [0, 6]
    assert _asked(monkeypatch, 7 * [whole] + 7 * [part]) == [0, 6, 8]


@pytest.mark.parametrize(
    ("region", "silhouette", "columns"), [("detection", True, (8, 40)), ("box", False, (4, 44))], ids=["all", "box"]
)
def test_the_backend_sees_the_region_that_is_asked_for(monkeypatch, region, silhouette, columns):
    seen = []

    class Watching(_Backend):
        def generate(self, frame, detection, prior):
            seen.append(detection)
            return DECIDED

    monkeypatch.setattr(hypothesis_stage, "create_backend", lambda *_: Watching())
    monkeypatch.setattr(hypothesis_stage, "symmetry_of", lambda target: Symmetry())
    config = HatConfig(segmentation=SegmentationConfig(pose_region=region, box_padding=0.125))
    whole = _detection(8, 40)
    whole.mask[8:20, 8:20] = False
    HypothesisStage(config, None).update(Frame(1, np.zeros((64, 64, 3), np.uint8), CAMERA), whole, None)
    assert seen[0].silhouette == silhouette
    assert tuple(np.flatnonzero(seen[0].mask.any(axis=0))[[0, -1]] + [0, 1]) == columns
    assert seen[0].mask[4:44, 4:44].all() != silhouette


def test_a_part_missing_inside_the_box_counts(monkeypatch):
    whole, holed = _detection(8, 40), _detection(8, 40)
    holed.mask[14:34, 14:34] = False
    assert _asked(monkeypatch, [holed] + 7 * [whole]) == [0, 2]


@pytest.mark.parametrize(("supported", "asked"), [(False, [0, 2]), (True, [0])])
def test_a_changed_mask_is_no_matter_while_an_image_supports_the_track(monkeypatch, supported, asked):
    row = np.array([0, 0, 5, 0, 0, 0, 1.0])
    prior = PosePrior(1, row, row, healthy=False, supported=supported)
    assert _asked(monkeypatch, [_detection(8, 20)] + 5 * [_detection(8, 40)], prior) == asked


def test_a_target_that_only_turns_a_little_is_not_tried_again(monkeypatch):
    growing = [_detection(8, 30 + i) for i in range(6)]
    assert _asked(monkeypatch, growing) == [0]


@pytest.mark.parametrize(
    ("box", "overlap"), [((0, 0, 4, 4), 1.0), ((2, 0, 6, 4), 1 / 3), ((4, 0, 8, 4), 0.0), ((1, 1, 3, 3), 0.25)]
)
def test_the_overlap_of_boxes(box, overlap):
    a, b = np.array([0.0, 0, 4, 4]), np.array(box, dtype=np.float64)
    assert box_overlap(a, b) == box_overlap(b, a) == pytest.approx(overlap)


class _Turning:
    """Candidates of a body with quarter turns: a new one of the four at every keyframe, and one that is no equal."""

    def __init__(self):
        self.calls = 0

    def generate(self, frame, detection, prior):
        turns = [[0, 0, self.calls * np.pi / 2], [0.6, 0, self.calls * np.pi / 2 + 0.3]]
        self.calls += 1
        T = lie.transform(lie.so3_exp(np.array(turns, float)), np.tile([0.0, 0, 5], (2, 1)))
        return Candidates.from_matrices(T, np.array([0.0, -1.0]))

    def reset(self):
        pass


@pytest.mark.parametrize("tracked", [False, True])
def test_of_equal_orientations_the_one_nearest_to_the_track_is_given(monkeypatch, tracked):
    """Without a track: nearest to the best of the last keyframe."""
    quarters = about_center(lie.so3_exp(np.outer(np.arange(4) * np.pi / 2, [0, 0, 1.0])), np.zeros(3))
    monkeypatch.setattr(hypothesis_stage, "create_backend", lambda *_: _Turning())
    monkeypatch.setattr(hypothesis_stage, "symmetry_of", lambda target: Symmetry(quarters))
    row = lie.row_from_matrix(lie.transform(lie.so3_exp(np.array([0, 0, 3.0])), np.array([0, 0, 5.0])))
    prior = PosePrior(1, row, row, healthy=False, supported=True) if tracked else None
    stage = HypothesisStage(HatConfig(keyframes=KeyframeConfig(gap_frames=1, settled_factor=1)), None)
    image, mask = np.zeros((64, 64, 3), np.uint8), _detection(8, 40)
    found = [stage.update(Frame(i + 1, image, CAMERA), mask, prior).T_cam_target for i in range(4)]
    for best, other in found:
        np.testing.assert_allclose(best[:3, :3], lie.so3_exp(np.array([0, 0, np.pi if tracked else 0.0])), atol=1e-12)
        assert lie.angle_between(other[:3, :3], best[:3, :3]) < np.radians(46)


def test_the_track_of_a_body_of_revolution_is_never_settled(monkeypatch):
    row = np.array([0, 0, 5, 0, 0, 0, 1.0])
    prior = PosePrior(1, row, row, healthy=True, supported=True)
    steady = 60 * [_detection(8, 40)]
    assert np.diff(_asked(monkeypatch, steady, prior)).max() == 18
    free = Symmetry(axes=np.array([[0, 0, 1.0]]))
    assert set(np.diff(_asked(monkeypatch, steady, prior, free))) == {6}
