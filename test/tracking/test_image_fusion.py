"""Fusion with an eye on the image, with a refiner whose image is a known set of basins."""

from dataclasses import replace

import numpy as np
import pytest
from temporal_scene import HALF_TURN, make_scene, preset, rotation_error_deg

from hat_ros.core.fusion import FusionStage
from hat_ros.geometry import lie
from hat_ros.tracking.image_fusion import ImageFusion, quality
from hat_ros.types import Camera, Candidates, Frame, Motion, Refined, Selection, StateReason, TrackState

COVARIANCE = np.diag([1e-6] * 6)


class BasinRefiner:
    """Snaps to the nearest of the frame's basins within 15 degrees; each basin has its own image evidence."""

    def __init__(self, scene, evidence=None):
        self._scene = scene
        self._evidence = evidence or (lambda index: {"true": (0.97, 0.97), "flipped": (0.8, 0.8)})
        self.calls = 0

    def refine(self, frame, detection, T_cam_target, prior=None):
        self.calls += 1
        index = frame.stamp_ns // 10**8 - 1
        truth = self._scene.T_cam_target[index]
        for name, turn in (("true", np.eye(3)), ("flipped", HALF_TURN)):
            basin = lie.transform(truth[:3, :3] @ turn, truth[:3, 3])
            near = rotation_error_deg(basin, T_cam_target) < 15
            evidence = self._evidence(index).get(name)
            if near and evidence is not None and np.linalg.norm(basin[:3, 3] - T_cam_target[:3, 3]) < 1.0:
                return Refined(lie.row_from_matrix(basin), COVARIANCE, *evidence, visible_overlap=evidence[0])
        return None

    def reset(self):
        self.calls = 0


def _selection(T_cam_target, lead=np.inf):
    """An anchor, and a candidate half a turn away that it leads by so much."""
    if np.isinf(lead):
        candidates = Candidates.from_matrices(T_cam_target[None], np.zeros(1))
        return Selection(candidates, np.zeros(1), np.zeros(1), 0)
    score = np.array([0.0, -lead])
    return Selection(Candidates.from_matrices(np.stack([T_cam_target, _flipped(T_cam_target)]), score), score, score, 0)


def _flipped(T):
    return lie.transform(T[:3, :3] @ HALF_TURN, T[:3, 3])


def _run(stage, scene, frames, anchor=lambda i, T: T, moving=True, lead=np.inf):
    """``anchor(i, truth)`` gives the anchor at keyframes, or None; ``lead`` is its lead over half a turn from it."""
    out = []
    for i in frames:
        T = anchor(i, scene.T_cam_target[i]) if scene.observations.key[i] else None
        frame = Frame((i + 1) * 10**8, np.zeros((1, 1, 3), np.uint8), Camera(np.eye(3), 1, 1))
        motion = scene.observations.motion(i) if moving else Motion.none()
        out.append(stage.update(frame, None, motion, Selection.none() if T is None else _selection(T, lead)))
    return out


@pytest.fixture(scope="module")
def scene():
    return make_scene(120, gap=8)


def _errors(estimates, scene, frames):
    return np.array(
        [rotation_error_deg(e.T_cam_target, scene.T_cam_target[i]) for e, i in zip(estimates, frames, strict=True)]
    )


def _stage(scene, evidence=None, **fusion):
    config = preset("default", fusion={"coast_limit_frames": 10, **fusion})
    return FusionStage(config, ImageFusion(config, BasinRefiner(scene, evidence)))


def _noisy(i, T):
    rng = np.random.default_rng(i)
    return lie.transform(lie.so3_exp(0.05 * rng.normal(size=3)) @ T[:3, :3], T[:3, 3] + 0.1 * rng.normal(size=3))


def test_every_frame_is_measured_from_the_first_anchor_on(scene):
    estimates = _run(_stage(scene), scene, range(120), _noisy)
    assert {e.state for e in estimates} == {TrackState.TRACKING}
    assert {e.gap_frames for e in estimates} == {0}
    np.testing.assert_allclose(_errors(estimates, scene, range(120)), 0, atol=1e-5)


def test_it_needs_no_slam(scene):
    estimates = _run(_stage(scene), scene, range(120), _noisy, moving=False)
    assert {e.state for e in estimates} == {TrackState.TRACKING}
    assert estimates[-1].alignment is None


def test_measured_keyframes_are_what_the_alignment_is_fitted_to(scene):
    estimates = _run(_stage(scene), scene, range(120), _noisy)
    assert estimates[16].alignment is not None
    assert estimates[119].alignment.rms < 1e-6


def test_one_wrong_anchor_is_outvoted_by_the_image(scene):
    estimates = _run(_stage(scene), scene, range(120), lambda i, T: _flipped(T) if i == 64 else T)
    assert (_errors(estimates, scene, range(120)) < 1e-5).all()
    assert estimates[64].gate_weight < 1
    assert estimates[-1].n_resets == 0


def test_a_wrong_start_is_left_as_soon_as_the_anchors_say_so(scene):
    """Before the warm-up one anchor is enough, unless the image contradicts it."""
    estimates = _run(_stage(scene), scene, range(40), lambda i, T: _flipped(T) if i == 0 else T)
    errors = _errors(estimates, scene, range(40))
    assert (errors[:8] > 170).all()
    assert (errors[8:] < 1e-5).all()
    assert estimates[-1].n_resets == 1


def test_a_locked_wrong_basin_is_left_when_the_image_prefers_the_anchor(scene):
    """Settled in the wrong basin; the competing basin's lead decides at its first appearance."""
    estimates = _run(_stage(scene), scene, range(120), lambda i, T: _flipped(T) if i < 56 else T)
    errors = _errors(estimates, scene, range(120))
    assert (errors[:56] > 170).all()
    assert (errors[56:] < 1e-5).all()


@pytest.mark.parametrize(("lead", "left"), [(1.0, 72), (6.0, 56)])
def test_a_track_that_anchors_support_is_not_left_for_one_with_a_small_margin(scene, lead, left):
    """Whatever the image prefers; three such anchors outnumber the two that support the track."""
    stage = _stage(scene)
    _run(stage, scene, range(16), lambda i, T: _flipped(T))
    _run(stage, scene, range(16, 56), lambda i, T: None)
    frames = range(56, 80)
    errors = _errors(_run(stage, scene, frames, lead=lead), scene, frames)
    assert 56 + int(np.argmax(errors < 90)) == left


def test_equal_evidence_leaves_the_decision_to_four_coherent_anchors(scene):
    def equal(index):
        return {"true": (0.9, 0.9), "flipped": (0.9, 0.9)}

    estimates = _run(_stage(scene, equal), scene, range(120), lambda i, T: _flipped(T) if i < 56 else T)
    errors = _errors(estimates, scene, range(120))
    assert (errors[56:80] > 170).all()
    assert (errors[80:] < 1e-5).all()


def test_a_worse_competing_basin_is_refused_however_coherent(scene):
    def worse(index):
        return {"true": (0.9, 0.9), "flipped": (0.7, 0.7)}

    estimates = _run(_stage(scene, worse), scene, range(120), lambda i, T: T if i < 40 else _flipped(T))
    assert (_errors(estimates, scene, range(120)) < 1e-5).all()


def test_unsupported_frames_coast_then_lose_and_a_supported_anchor_starts_again(scene):
    def dark(index):
        return {} if 40 <= index < 60 else {"true": (0.9, 0.9)}

    stage = _stage(scene, dark)
    estimates = _run(stage, scene, range(120), lambda i, T: T if not 40 <= i < 60 else _flipped(T))
    states = [e.state for e in estimates]
    assert states[40:50] == [TrackState.COASTING] * 10
    assert states[50:64] == [TrackState.LOST] * 14
    assert states[64:] == [TrackState.TRACKING] * 56
    trace = [np.trace(e.covariance) for e in estimates[40:50]]
    assert (np.diff(trace) > 0).all()


def test_while_coasting_the_pose_follows_the_motion(scene):
    def dark(index):
        return {} if 40 <= index < 48 else {"true": (0.9, 0.9)}

    estimates = _run(_stage(scene, dark), scene, range(60))
    assert (_errors(estimates, scene, range(60)) < 0.1).all()


@pytest.mark.parametrize("evidence", [(0.3, 0.9), (0.9, 0.1)], ids=["overlap", "support"])
def test_weak_evidence_is_no_measurement(scene, evidence):
    estimates = _run(_stage(scene, lambda index: {"true": evidence}), scene, range(30))
    assert TrackState.TRACKING not in {e.state for e in estimates}


def test_an_uncertain_start_is_tracking_only_after_a_second_anchor_agreed(scene):
    estimates = _run(_stage(scene, lambda index: {"true": (0.85, 0.85)}), scene, range(30))
    assert [e.state for e in estimates] == [TrackState.INITIALISING] * 8 + [TrackState.TRACKING] * 22
    assert {e.gap_frames for e in estimates} == {0}
    certain = _run(_stage(scene, lambda index: {"true": (0.95, 0.95)}), scene, range(30))
    assert {e.state for e in certain} == {TrackState.TRACKING}


@pytest.mark.parametrize(("n_missed", "in_doubt"), [(1, 0), (6, 6)])
def test_after_an_interruption_the_track_needs_a_new_confirmation(scene, n_missed, in_doubt):
    """The target went on turning between the frames."""
    frames = [*range(20), *range(20 + n_missed, 40)]
    estimates = _run(_stage(scene, lambda index: {"true": (0.85, 0.85)}), scene, frames)
    doubt = [i for i, e in zip(frames, estimates, strict=True) if i >= 8 and e.state != TrackState.TRACKING]
    assert doubt == list(range(26, 26 + in_doubt))


@pytest.mark.parametrize(("explained_at", "tracking_from"), [(None, 24), (4, 4), (12, 12)])
def test_a_mask_that_was_never_explained_well_needs_three_more_anchors(scene, explained_at, tracking_from):
    """However far the decoder's lead: a wrong mask errs alike at two keyframes, but no pose explains it well."""

    def evidence(index):
        return {"true": (0.86, 0.86) if index == explained_at else (0.75, 0.75)}

    estimates = _run(_stage(scene, evidence), scene, range(40), lead=20.0)
    assert [e.state for e in estimates] == [TrackState.INITIALISING] * tracking_from + [TrackState.TRACKING] * (
        40 - tracking_from
    )


@pytest.mark.parametrize(("apart_deg", "believed"), [(5.0, True), (20.0, False)])
def test_an_anchor_far_from_its_prediction_is_no_confirmation(scene, apart_deg, believed):
    turn = lie.so3_exp(np.radians([apart_deg, 0.0, 0.0]))
    anchor = lambda i, T: T if i == 0 else lie.transform(turn @ T[:3, :3], T[:3, 3])  # noqa: E731
    stage = _stage(scene, evidence=lambda index: {"true": (0.85, 0.85)})
    estimates = _run(stage, scene, range(10), anchor)
    assert (estimates[-1].state == TrackState.TRACKING) == believed


def test_a_track_that_anchors_contradict_is_in_doubt_until_two_agree(scene):
    """Competing basins without image support and without coherence: nothing to follow, but no certainty either."""
    turns = {40: [np.pi, 0, 0], 48: [0, 0, np.pi]}

    def anchor(i, T):
        return lie.transform(T[:3, :3] @ lie.so3_exp(np.array(turns[i], float)), T[:3, 3]) if i in turns else T

    estimates = _run(_stage(scene), scene, range(72), anchor)
    doubt = [i for i, e in enumerate(estimates) if e.state != TrackState.TRACKING]
    assert doubt == list(range(40, 64))
    assert (_errors(estimates, scene, range(72)) < 1e-5).all()


def test_a_competing_basin_must_outnumber_the_anchors_behind_the_track(scene):
    """Equal evidence: more coherent anchors than support the track, its first included; four at most."""

    def equal(index):
        return {"true": (0.9, 0.9), "flipped": (0.9, 0.9)}

    for n_for in (1, 2, 3, 6):
        estimates = _run(_stage(scene, equal), scene, range(120), lambda i, T, n=n_for: _flipped(T) if i < 8 * n else T)
        errors = _errors(estimates, scene, range(120))
        switched_at = 8 * n_for + 8 * (min(n_for + 1, 4) - 1)
        assert (errors[:switched_at] > 170).all()
        assert (errors[switched_at:] < 1e-5).all()


def test_anchors_that_no_image_has_supported_support_no_track(scene):
    """While the masks were wrong, what agreed was wrong alike: the first supported basin wins, however narrowly."""

    def masked_well(index):
        return {"true": (0.9, 0.9)} if index >= 40 else {}

    stage = _stage(scene, masked_well, coast_limit_frames=60)
    _run(stage, scene, range(24), lambda i, T: _flipped(T))
    _run(stage, scene, range(24, 40), lambda i, T: None)
    frames = range(40, 56)
    estimates = _run(stage, scene, frames, lead=1.0)
    np.testing.assert_allclose(_errors(estimates, scene, frames), 0, atol=1e-5)
    assert estimates[0].n_resets == 1


@pytest.mark.parametrize(("lead", "left_after"), [(1.0, 1), (6.0, 4)])
def test_anchors_with_a_small_margin_do_not_support_a_track(scene, lead, left_after):
    """The decoder remembers how close it was: where it changes its mind, as many more anchors would only be late."""
    keyframes = np.flatnonzero(scene.observations.key)
    stage = _stage(scene, lambda _: {"true": (0.8, 0.8), "flipped": (0.8, 0.8)})
    turned = keyframes[4]
    _run(stage, scene, range(turned), lambda i, T: _flipped(T), lead=lead)
    frames = range(turned, keyframes[9])
    errors = _errors(_run(stage, scene, frames), scene, frames)
    left = turned + int(np.argmax(errors < 90))
    assert left == keyframes[4 + left_after - 1]


class TestCovariance:
    def test_exact_anchors_leave_the_image_its_covariance(self, scene):
        estimates = _run(_stage(scene), scene, range(60))
        np.testing.assert_allclose(estimates[50].covariance, COVARIANCE, atol=1e-12)

    def test_scattered_anchors_widen_it_where_they_scatter(self, scene):
        """A mask's systematic errors and a smooth body's roll show in no residual, but between keyframes."""
        axis = np.array([0.0, 0.0, 1.0])

        def rolled(i, T):
            return lie.transform(lie.so3_exp(np.radians(8.0) * (-1) ** (i // 8) * axis) @ T[:3, :3], T[:3, 3])

        covariance = _run(_stage(scene), scene, range(60), rolled)[50].covariance
        assert np.radians(8.0) ** 2 <= axis @ covariance[3:, 3:] @ axis <= 2.5 * np.radians(8.0) ** 2
        np.testing.assert_allclose(np.diag(covariance)[:5], np.diag(COVARIANCE)[:5], atol=1e-9)

    def test_other_basins_do_not_widen_it(self, scene):
        estimates = _run(_stage(scene), scene, range(60), lead=5.0)
        np.testing.assert_allclose(estimates[50].covariance, COVARIANCE, atol=1e-12)

    @pytest.mark.parametrize(("misfit_px", "sigma_rad"), [(1.0, 2**0.5 * 1e-3), (1e4, np.radians(30))])
    def test_a_pixel_of_misfit_doubles_the_variance_up_to_the_basin(self, scene, misfit_px, sigma_rad):
        class Misfit(BasinRefiner):
            def refine(self, *arguments):
                refined = super().refine(*arguments)
                return None if refined is None else replace(refined, misfit_px=misfit_px)

        config = preset("default")
        estimates = _run(FusionStage(config, ImageFusion(config, Misfit(scene))), scene, range(20))
        np.testing.assert_allclose(np.sqrt(np.diag(estimates[-1].covariance))[3:], sigma_rad, rtol=0.01)


def test_evidence_is_what_can_be_seen():
    def refined(**changes):
        return Refined(np.zeros(7), COVARIANCE, **{"overlap": 0.4, "support": 0.7, "visible_overlap": 0.9, **changes})

    assert quality(refined()) == pytest.approx(0.8)
    assert quality(refined(overlap=0.1)) == quality(refined())
    assert quality(refined(overlap=float("nan"), visible_overlap=float("nan"))) == 0.7
    assert quality(None) == 0.0


def test_a_quiet_frame_costs_one_refinement(scene):
    refiner = BasinRefiner(scene)
    stage = FusionStage(preset("default"), ImageFusion(preset("default"), refiner))
    _run(stage, scene, range(40))
    refiner.calls = 0
    _run(stage, scene, range(41, 48))
    assert refiner.calls == 7


def test_a_rate_that_no_image_has_confirmed_of_late_is_not_tried(scene):
    def dark(index):
        return {"true": (0.9, 0.9)} if index < 41 else {}

    refiner, config = BasinRefiner(scene, dark), preset("default", fusion={"coast_limit_frames": 60})
    stage = FusionStage(config, ImageFusion(config, refiner))
    _run(stage, scene, range(41))
    refiner.calls = 0
    still = scene.observations.motion(40)  # the target turns on, the motion does not say so
    for i in range(41, 61):
        frame = Frame((i + 1) * 10**8, np.zeros((1, 1, 3), np.uint8), Camera(np.eye(3), 1, 1))
        stage.update(frame, None, still, Selection.none())
    turned_deg = rotation_error_deg(scene.T_cam_target[60], scene.T_cam_target[40])
    assert turned_deg > 2 * preset("default").refinement.same_pose_deg
    assert refiner.calls <= 21  # the first of these frames may try the rate


def test_before_the_alignment_the_constant_rate_says_how_far_the_target_moves(scene):
    starts = {}

    class Recording(BasinRefiner):
        def refine(self, frame, detection, T_cam_target, prior=None):
            starts.setdefault(frame.stamp_ns // 10**8 - 1, T_cam_target)
            return super().refine(frame, detection, T_cam_target, prior)

    stage = FusionStage(preset("default"), ImageFusion(preset("default"), Recording(scene)))
    estimates = _run(stage, scene, range(8))
    assert estimates[-1].alignment is None
    for i in range(3, 8):
        missed = np.linalg.norm(starts[i][:3, 3] - scene.T_cam_target[i, :3, 3])
        moved = np.linalg.norm(np.diff(scene.T_cam_target[i - 1 : i + 1, :3, 3], axis=0))
        assert missed < 0.3 * moved


def test_prefix_and_reset(scene):
    a = _run(_stage(scene), scene, range(60), _noisy)
    stage = _stage(scene)
    b = _run(stage, scene, range(30), _noisy)
    assert [e.pose_row.tobytes() for e in a[:30]] == [e.pose_row.tobytes() for e in b]
    stage.reset()
    c = _run(stage, scene, range(60), _noisy)
    assert [e.pose_row.tobytes() for e in a] == [e.pose_row.tobytes() for e in c]


def test_before_a_confirmation_the_state_is_initialising_and_after_it_coasting(scene):
    def evidence(index):
        return {} if 24 <= index < 28 else {"true": (0.85, 0.85)}

    estimates = _run(_stage(scene, evidence), scene, range(40))
    first, between, coasting = estimates[0], estimates[8], estimates[24]
    assert (first.state, first.reason) == (TrackState.INITIALISING, StateReason.UNCONFIRMED)
    assert (between.state, between.reason) == (TrackState.TRACKING, StateReason.CONFIRMED)
    assert (coasting.state, coasting.reason) == (TrackState.COASTING, StateReason.NOT_MEASURED)
    assert np.isfinite(first.pose_row).all() and np.isfinite(first.covariance).all()


def test_what_is_found_after_a_loss_has_to_be_confirmed_anew(scene):
    def dark(index):
        return {} if 24 <= index < 48 else {"true": (0.85, 0.85)}

    states = [
        e.state for e in _run(_stage(scene, dark), scene, range(70), lambda i, T: T if i < 24 or i >= 48 else None)
    ]
    assert states[23] == TrackState.TRACKING
    assert states[47] == TrackState.LOST
    assert states[48:56] == [TrackState.INITIALISING] * 8
    assert states[56:] == [TrackState.TRACKING] * 14


def test_a_stage_that_is_told_of_an_earlier_confirmation_coasts_until_the_next(scene):
    stage = _stage(scene, lambda index: {"true": (0.85, 0.85)})
    stage.reset()
    stage.resume()
    assert [e.state for e in _run(stage, scene, range(12))] == [TrackState.COASTING] * 8 + [TrackState.TRACKING] * 4
    stage.reset()
    assert _run(stage, scene, range(12, 20))[-1].state == TrackState.INITIALISING


def test_the_reason_names_what_is_missing(scene):
    def reasons(evidence, anchor=lambda i, T: T, lead=20.0):
        return [e.reason for e in _run(_stage(scene, evidence), scene, range(72), anchor, lead=lead)]

    def contradicted(i, T):
        turn = {40: [np.pi, 0, 0], 48: [0, 0, np.pi]}.get(i)
        return T if turn is None else lie.transform(T[:3, :3] @ lie.so3_exp(np.array(turn, float)), T[:3, 3])

    assert reasons(lambda index: {"true": (0.75, 0.75)})[1] == StateReason.UNEXPLAINED
    assert reasons(lambda index: {"true": (0.95, 0.95)}, lead=0.1)[1] == StateReason.AMBIGUOUS
    assert StateReason.CONTRADICTED in reasons(None, contradicted, lead=np.inf)[48:64]
