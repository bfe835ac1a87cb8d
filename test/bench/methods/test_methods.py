"""The methods beside HAT: what each may know, and that all offer the same seam."""

import numpy as np
import pytest
import scripted_backends
from scripted import stamp
from scripted_backends import index_of, true_pose

from hat_ros.bench.methods.modes import MODES, create_method
from hat_ros.bench.synth.models import build_target
from hat_ros.config import config_from_dict
from hat_ros.errors import UsageError
from hat_ros.geometry import lie
from hat_ros.stages import BACKENDS, WHOLE_CLIP_MOTIONS
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.tracker import HatTracker, unwrapped
from hat_ros.types import Camera, Frame, TrackState

CAMERA = Camera(np.array([[300.0, 0, 79.5], [0, 300.0, 59.5], [0, 0, 1]]), 160, 120)
SETTINGS = {
    "segmentation": {"backend": "annotated"},
    "hypotheses": {"backend": "knowing"},
    "slam": {"backend": "knowing"},
    "keyframes": {"gap_frames": 2, "settled_factor": 1},
    "selector": {"score_scale": 3.0, "max_motion_penalty": 0.0, "max_turn_deg_per_frame": 0.0},
    "fusion": {"gate_angle_deg": 30.0},
    "refinement": {"enabled": False},
    "prior": {"enabled": False},
}
N = 24


@pytest.fixture(scope="module")
def target():
    return build_target("cubesat")


@pytest.fixture(scope="module")
def frames(target):
    renderer = RayRenderer(target)
    out = []
    for i in range(N):
        seen = renderer.render(true_pose(i), CAMERA)
        shade = 0.4 + 0.6 * np.abs(seen.normal_cam[..., 2:])
        rgb = np.where(seen.mask[..., None], np.maximum(seen.rgb, 60) * shade, 0).astype(np.uint8)
        out.append(Frame(stamp(i), rgb, CAMERA, np.where(seen.mask, 255, 0).astype(np.uint8)))
    return out


@pytest.fixture(autouse=True)
def knowing(monkeypatch):
    monkeypatch.setitem(BACKENDS["hypotheses"], "knowing", "scripted_backends:KnowingHypotheses")
    monkeypatch.setitem(BACKENDS["slam"], "knowing", "scripted_backends:KnowingSlam")


def run(mode, frames, target, **more):
    method = create_method(mode, config_from_dict(SETTINGS | more), target, unwrapped)
    steps = [method.step(frame) for frame in frames]
    return steps, method


def errors_deg(estimates):
    return np.array(
        [
            np.degrees(lie.angle_between(e.T_cam_target[:3, :3], true_pose(index_of(e.stamp_ns))[:3, :3]))
            for e in estimates
        ]
    )


def blind(frame):
    return Frame(frame.stamp_ns, np.zeros_like(frame.rgb), frame.camera, np.zeros_like(frame.given_mask))


def test_unknown_mode_is_refused(target):
    with pytest.raises(UsageError, match="'magic' is unknown"):
        create_method("magic", config_from_dict(SETTINGS), target, unwrapped)


@pytest.mark.parametrize("mode", [mode for mode in MODES if mode != "offline"])
def test_causal_methods_have_nothing_to_add_at_the_end(mode, frames, target):
    steps, method = run(mode, frames[:3], target)
    assert method.causal
    assert method.finish() == []
    assert [step.estimate.stamp_ns for step in steps] == [frame.stamp_ns for frame in frames[:3]]


def test_hat_is_the_tracker(frames, target):
    steps, _ = run("hat", frames, target)
    tracker = HatTracker(config_from_dict(SETTINGS), target)
    for step, frame in zip(steps, frames, strict=True):
        np.testing.assert_array_equal(step.estimate.pose_row, tracker.step(frame).estimate.pose_row)


def test_independent_takes_the_best_appearance_of_every_frame_and_remembers_nothing(frames, target):
    steps, _ = run("independent", frames, target)
    wrong = errors_deg([step.estimate for step in steps]) > 90
    np.testing.assert_array_equal(wrong, np.arange(N) % 3 == 2)
    alone, _ = run("independent", frames[7:8], target)
    np.testing.assert_array_equal(alone[0].estimate.pose_row, steps[7].estimate.pose_row)


def test_independent_without_a_detection_has_no_pose(frames, target):
    steps, _ = run("independent", [frames[0], blind(frames[1])], target)
    assert steps[1].estimate.state == TrackState.LOST
    assert np.isnan(steps[1].estimate.pose_row).all()


def test_hat_beats_independent_where_appearance_flips(frames, target):
    hat, _ = run("hat", frames, target)
    assert (errors_deg([step.estimate for step in hat][6:]) < 5).all()


def test_tracking_asks_for_hypotheses_only_to_start(frames, target):
    steps, _ = run("tracking", frames, target)
    assert [len(step.candidates) > 0 for step in steps] == [True] + [False] * (N - 1)
    assert errors_deg([step.estimate for step in steps]).max() < 3.0


def test_tracking_starts_afresh_when_it_is_lost(frames, target):
    gap = [frames[0], *(blind(frame) for frame in frames[1:4]), *frames[4:6]]
    steps, _ = run("tracking", gap, target)
    assert steps[3].estimate.state == TrackState.LOST
    assert len(steps[4].candidates) > 0
    assert steps[5].estimate.state == TrackState.TRACKING


def test_offline_answers_at_the_end_for_every_frame(frames, target):
    steps, method = run("offline", frames, target)
    assert not method.causal
    final = method.finish()
    assert [e.stamp_ns for e in final] == [s.estimate.stamp_ns for s in steps]
    assert (errors_deg(final) < 2.0).all(), "smoothing also corrects the frames of the warm-up"


def test_offline_refines_on_the_images_where_the_configuration_does(frames, target):
    _, method = run("offline", frames[:8], target, refinement={"enabled": True})
    final = method.finish()
    assert all(np.isfinite(e.covariance).all() for e in final), "a refined pose knows its uncertainty"


def test_whole_clip_smoothing_is_on_average_no_worse_than_the_causal_poses(frames, target):
    steps, method = run("offline", frames, target, refinement={"enabled": True})
    causal_deg, offline_deg = errors_deg([step.estimate for step in steps]), errors_deg(method.finish())
    assert offline_deg.mean() <= causal_deg.mean()


def test_offline_leaves_the_causal_pose_where_an_anchor_stands_alone(frames, target, monkeypatch):
    monkeypatch.setitem(BACKENDS["slam"], "knowing", "scripted_backends:NoSlam")
    steps, method = run("offline", frames, target, refinement={"enabled": True})
    causal_deg, offline_deg = errors_deg([step.estimate for step in steps]), errors_deg(method.finish())
    assert offline_deg.mean() <= causal_deg.mean() + 1e-9


def test_offline_takes_the_motion_of_the_whole_clip_where_the_backend_has_one(frames, target, monkeypatch):
    monkeypatch.setitem(WHOLE_CLIP_MOTIONS, "knowing", "scripted_backends:knowing_whole_clip")
    monkeypatch.setitem(BACKENDS["slam"], "knowing", "scripted_backends:ReversedSlam")
    steps, method = run("offline", frames, target, slam={"backend": "knowing"})
    assert errors_deg([step.estimate for step in steps][6:]).max() > 5.0, "reversed motion misleads the causal pose"
    assert (errors_deg(method.finish()) < 2.0).all()
    assert scripted_backends.seen_whole_clip == [(frame.stamp_ns, 0) for frame in frames], "background suppressed"


def test_offline_of_nothing_is_nothing(target):
    _, method = run("offline", [], target)
    assert method.finish() == []


def test_observe_sees_candidates_at_every_frame_and_says_nothing(frames, target):
    steps, _ = run("observe", frames, target)
    assert all(len(step.candidates) == 2 and step.motion.valid for step in steps)
    assert all(step.estimate.state == TrackState.UNINITIALISED for step in steps)


def test_srt3d_starts_once_and_never_again(frames, target):
    steps, _ = run("srt3d", [blind(frames[0]), *frames[1:]], target)
    assert steps[0].estimate.state == TrackState.UNINITIALISED
    assert [len(step.candidates) > 0 for step in steps] == [False, True] + [False] * (N - 2)
    assert np.isfinite(steps[-1].estimate.pose_row).all()
