from dataclasses import replace

import numpy as np
import pytest
from shape_scene import CAMERA, picture, random_pose, spacecraft

from hat_ros.geometry import lie
from hat_ros.hypotheses.scoring import Evidence, Scorer, log_score, shape_score
from hat_ros.refinement.mask_field import MaskField
from hat_ros.refinement.pose_fitter import PoseFitter, Schedule
from hat_ros.refinement.view import TargetViewer

_MEASURE = Schedule((4,), (1.5,), (1.5,))


@pytest.fixture(scope="module")
def viewer():
    return TargetViewer(spacecraft())


def score(viewer, frame, mask, T):
    field = MaskField(mask)
    view = viewer.view(T, CAMERA, 96)
    fit = PoseFitter(viewer, 96, 200).iterate(T, view, CAMERA, frame.rgb, field, _MEASURE)
    return log_score(Scorer(viewer, frame, field, 96).evidence(fit, view))


@pytest.mark.parametrize("seed", range(4))
def test_the_true_pose_beats_every_other_orientation_by_units(viewer, seed):
    rng = np.random.default_rng(seed)
    T_true = random_pose(rng, viewer.target)
    frame, mask = picture(viewer.target, T_true)
    best = score(viewer, frame, mask, T_true)
    for _ in range(5):
        turned = T_true.copy()
        turned[:3, :3] = T_true[:3, :3] @ lie.so3_exp(rng.uniform(0.6, 3.0) * np.array([0.6, 0.0, 0.8]))
        assert score(viewer, frame, mask, turned) < best - 2


def test_a_missing_part_costs_more_before_a_bright_background(viewer):
    T_true = random_pose(np.random.default_rng(1), viewer.target)
    scorers = []
    for background in (0, 150):
        frame, mask = picture(viewer.target, T_true, background=background)
        partial = mask.copy()
        partial[:, : CAMERA.width // 2] = False
        dark = replace(frame, rgb=np.where(partial[..., None], frame.rgb, np.uint8(background)))
        scorers.append(Scorer(viewer, dark, MaskField(partial), 96))
    view = viewer.view(T_true, CAMERA, 96)
    before_black, before_bright = (s.mismatch(view, 100.0, 0.5) for s in scorers)
    assert before_black[1] == pytest.approx(0, abs=1e-6)
    assert before_black[2] > 1
    assert before_bright[2] == pytest.approx(0, abs=1e-6)
    assert before_bright[1] == pytest.approx(before_black[2], rel=1e-6)


@pytest.mark.parametrize("name", ["excess_px", "missing_px", "hidden_px", "mask_rms_px"])
def test_every_mismatch_lowers_the_score(name):
    good = Evidence(0.95, 0.1, 0.1, 0.1, 0.3, 0.9, 0.9)
    assert log_score(replace(good, **{name: 1.0})) < log_score(good)


def test_no_mismatch_is_the_best_shape():
    assert shape_score(0.0, 0.0, 0.0) == 0.0
    assert shape_score(0.2, 0.1, 0.3) < 0.0
