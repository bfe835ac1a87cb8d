"""Stage 4 as the tracker sees it: states, covariance, quaternion signs, bounded memory."""

from dataclasses import replace

import numpy as np
import pytest
from temporal_scene import make_scene, preset

from hat_ros.core.covariance import ResidualCovariance
from hat_ros.core.fusion import FusionStage
from hat_ros.core.published_fusion import PublishedFusion
from hat_ros.core.selector import SelectorStage
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import FREE_VARIANCE_RAD2, Symmetry, about_center
from hat_ros.types import Camera, Candidates, Frame, Motion, Selection, TrackState


def frame(index):
    return Frame((index + 1) * 10**8, np.zeros((1, 1, 3), np.uint8), Camera(np.eye(3), 1, 1))


def _stage(config):
    return FusionStage(config, PublishedFusion(config))


def _selection(T_cam_target):
    candidates = Candidates.from_matrices(T_cam_target[None], np.zeros(1))
    return Selection(candidates, np.zeros(1), np.zeros(1), 0)


def _run(stage, scene, frames, anchored=True, moving=True):
    out = []
    for i in frames:
        key = anchored and scene.observations.key[i]
        selection = _selection(scene.T_cam_target[i]) if key else Selection.none()
        motion = scene.observations.motion(i) if moving else Motion.none()
        out.append(stage.update(frame(i), None, motion, selection))
    return out


def test_states_from_the_first_anchor_to_lost_and_back():
    scene = make_scene(200)
    stage = _stage(preset(fusion={"coast_limit_frames": 10}))
    before = _run(stage, scene, range(1, 4))
    assert [e.state for e in before] == [TrackState.UNINITIALISED] * 3
    assert all(np.isnan(e.pose_row).all() and np.isnan(e.covariance).all() for e in before)

    started = _run(stage, scene, range(4, 40))
    assert started[0].state == TrackState.TRACKING
    assert started[1].state == TrackState.COASTING
    assert {e.state for e in started[12:]} == {TrackState.TRACKING}

    blind = _run(stage, scene, range(40, 60), anchored=False, moving=False)
    since = blind[0].gap_frames
    assert [e.gap_frames for e in blind] == list(range(since, since + 20))
    assert [e.state for e in blind] == [TrackState.COASTING if e.gap_frames <= 10 else TrackState.LOST for e in blind]
    assert all(np.isnan(e.pose_row).all() for e in blind if e.state == TrackState.LOST)

    back = _run(stage, scene, range(60, 80))
    assert {e.state for e in back} == {TrackState.TRACKING}
    assert back[0].gap_frames == 0


def test_motion_without_anchors_is_lost_in_the_end():
    scene = make_scene(120)
    stage = _stage(preset(fusion={"coast_limit_frames": 30}))
    _run(stage, scene, range(41))
    drifting = _run(stage, scene, range(41, 120), anchored=False)
    assert [e.state for e in drifting[:30]] == [TrackState.TRACKING] * 30
    assert {e.state for e in drifting[30:]} == {TrackState.LOST}


def test_without_a_limit_the_last_pose_is_held_and_never_lost():
    scene = make_scene(120)
    stage = _stage(preset(fusion={"coast_limit_frames": 0}))
    last = _run(stage, scene, range(21))[-1]
    blind = _run(stage, scene, range(21, 120), anchored=False, moving=False)
    assert {e.state for e in blind} == {TrackState.COASTING}
    np.testing.assert_array_equal(blind[-1].pose_row, last.pose_row)


def test_frames_that_are_not_scored_count_for_nothing():
    """Every third frame is a target: all that comes of these is what comes of a recording of these alone."""
    scene = make_scene(120, gap=12)
    sparse, alone = _stage(preset()), _stage(preset())
    for i in range(120):
        selection = _selection(scene.T_cam_target[i]) if i % 12 == 0 else Selection.none()
        motion, target = scene.observations.motion(i), i % 3 == 0
        seen = sparse.update(replace(frame(i), scored=target), None, motion, selection)
        if target:
            expected = alone.update(frame(i), None, motion, selection)
            np.testing.assert_array_equal(seen.pose_row, expected.pose_row)
            assert seen.gap_frames == expected.gap_frames
        else:
            assert not seen.state.has_pose


def test_the_estimate_reports_what_happened():
    scene = make_scene(40)
    estimates = _run(_stage(preset()), scene, range(40))
    assert [e.stamp_ns for e in estimates] == [(i + 1) * 10**8 for i in range(40)]
    assert [e.keyframe for e in estimates] == scene.observations.key.tolist()
    assert [e.anchor for e in estimates] == np.where(scene.observations.key, 0, -1).tolist()
    assert [e.alignment is None for e in estimates] == [i < 8 for i in range(40)]
    assert estimates[36].gate_weight == 1.0
    assert np.isnan(estimates[37].gate_weight)
    assert estimates[39].n_candidates == 0


def test_quaternions_stay_in_one_hemisphere_through_full_turns():
    scene = make_scene(400, rate_deg=4.0)
    rows = np.stack([e.pose_row for e in _run(_stage(preset()), scene, range(400))])
    assert (np.sum(rows[1:, 3:] * rows[:-1, 3:], axis=1) > 0.5).all()
    assert (rows[:, 6] < 0).any()
    assert (rows[:, 6] > 0).any()


def test_a_reset_stage_is_a_new_stage():
    scene = make_scene(60)
    stage = _stage(preset())
    _run(stage, scene, range(30, 60))
    stage.reset()
    again, fresh = _run(stage, scene, range(60)), _run(_stage(preset()), scene, range(60))
    for a, b in zip(again, fresh, strict=True):
        assert a.pose_row.tobytes() == b.pose_row.tobytes()
        assert a.covariance.tobytes() == b.covariance.tobytes()
        assert (a.state, a.gap_frames, a.n_resets) == (b.state, b.gap_frames, b.n_resets)


def _size(value, seen):
    """Bytes of arrays and number of things reachable from an object of ours."""
    if id(value) in seen:
        return 0
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, dict):
        return sum(_size(item, seen) for item in value.values()) + 8 * len(value)
    if isinstance(value, (list, tuple, set)) or type(value).__name__ == "deque":
        return sum(_size(item, seen) for item in value) + 8 * len(value)
    return _size(vars(value), seen) if hasattr(value, "__dict__") else 8


@pytest.mark.parametrize("name", ["mega_hat", "pico_hat", "mega_hat_spark"])
def test_the_state_of_stages_three_and_four_does_not_grow(name):
    config = preset(name, alignment={"max_observations": 32})
    scene = make_scene(400, k=3, gap=2)
    selector, fusion, sizes = SelectorStage(config.selector), _stage(config), []
    for i in range(400):
        motion = scene.observations.motion(i)
        selection = selector.update(scene.observations.candidates(i, config.hypotheses.guard), motion)
        fusion.update(frame(i), None, motion, selection)
        if i % 80 == 79:
            sizes.append(_size(vars(selector), set()) + _size(vars(fusion), set()))
    assert max(sizes[2:]) <= 1.05 * sizes[1]


class TestCovariance:
    def test_is_symmetric_positive_and_grows_between_measurements(self):
        scene = make_scene(80)
        stage = _stage(preset())
        estimates = _run(stage, scene, range(60)) + _run(stage, scene, range(60, 80), anchored=False)
        for e in estimates:
            np.testing.assert_allclose(e.covariance, e.covariance.T, atol=1e-18)
            assert np.linalg.eigvalsh(e.covariance).min() >= -1e-15
        trace = [np.trace(e.covariance) for e in estimates]
        assert (np.diff(trace[60:]) > 0).all()
        assert trace[56] < trace[4]

    def test_follows_the_size_of_the_residuals(self):
        rng, covariance = np.random.default_rng(0), ResidualCovariance()
        T = lie.transform(np.eye(3), np.array([0.0, 0, 8]))
        for _ in range(400):
            step = lie.transform(lie.so3_exp(0.02 * rng.normal(size=3)), 0.05 * rng.normal(size=3))
            measured = lie.transform(step[:3, :3], T[:3, 3] + step[:3, 3])
            C = covariance.update(T, measured, T, None)
        np.testing.assert_allclose(np.sqrt(np.diag(C)), [0.05] * 3 + [0.02] * 3, rtol=0.6)

    def test_a_measurements_own_covariance_is_used_and_then_grows(self):
        covariance, T = ResidualCovariance(), lie.transform(np.eye(3), np.array([0.0, 0, 8]))
        own = np.diag([1e-4] * 6)
        np.testing.assert_array_equal(covariance.update(T, T, None, own), own)
        assert np.trace(covariance.update(T, None, T, None)) > np.trace(own)


QUARTERS = Symmetry(about_center(lie.so3_exp(np.outer(np.arange(4) * np.pi / 2, [0, 0, 1.0])), np.zeros(3)))


def _run_among_equals(stage, scene):
    """At each keyframe the four equals of the true pose; the anchor is another one each time."""
    out, n = [], 0
    for i in range(len(scene.T_cam_target)):
        selection = Selection.none()
        if scene.observations.key[i]:
            T, n = scene.T_cam_target[i] @ np.roll(QUARTERS.turns, n, axis=0), n + 1
            score = np.zeros(len(T))
            selection = Selection(Candidates(lie.row_from_matrix(T), score), score, score, 0)
        out.append(stage.update(frame(i), None, scene.observations.motion(i), selection))
    return out


@pytest.mark.parametrize("free", [False, True])
def test_the_output_of_a_symmetric_target_is_continuous(free):
    scene = make_scene(120)
    symmetry = Symmetry(axes=np.array([[0, 0, 1.0]])) if free else QUARTERS
    stage = FusionStage(preset(), PublishedFusion(preset()), symmetry)
    estimates = [e for e in _run_among_equals(stage, scene) if e.state.has_pose]
    R = np.stack([e.T_cam_target[:3, :3] for e in estimates])
    step_deg = np.degrees(lie.angle_between(R[1:], R[:-1]))
    R_true = scene.T_cam_target[-len(R) :, :3, :3]
    true_step_deg = np.degrees(lie.angle_between(R_true[1:], R_true[:-1]))
    assert step_deg.max() < 4.0 * true_step_deg.max() + 0.1, "at first it is held between keyframes"
    assert {(e.order, e.free_axes) for e in estimates} == {(1, 1) if free else (4, 0)}
    nearest = symmetry.nearest(scene.T_cam_target[-len(R) :], R)
    assert np.degrees(lie.angle_between(nearest[:, :3, :3], R)).max() < 3.1

    unaware = _run_among_equals(_stage(preset()), scene)
    R = np.stack([e.T_cam_target[:3, :3] for e in unaware if e.state.has_pose])
    assert np.degrees(lie.angle_between(R[1:], R[:-1])).max() > 45, "it is this that makes it so"


def test_the_variance_about_a_free_axis_is_that_of_a_full_turn():
    scene = make_scene(40)
    symmetry = Symmetry(axes=np.array([[0, 0, 1.0]]))
    plain = _run(_stage(preset()), scene, range(40))[-1]
    free = _run(FusionStage(preset(), PublishedFusion(preset()), symmetry), scene, range(40))[-1]
    axis = free.T_cam_target[:3, 2]
    added = (free.covariance - plain.covariance)[3:, 3:]
    assert axis @ added @ axis == pytest.approx(FREE_VARIANCE_RAD2, rel=0.05)
    across = np.cross(axis, [1.0, 0, 0])
    assert abs(across @ added @ across) < 1e-2
