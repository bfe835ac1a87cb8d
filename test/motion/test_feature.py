"""The backend ``feature`` on rendered clips: laws, not figures."""

import gc
import sys
import tracemalloc

import numpy as np
import pytest
from speckled_clip import CAMERA, FRAME_NS, speckled_clip, turn_errors_deg

from hat_ros.config import FeatureSlamConfig, HatConfig, PriorConfig, SlamConfig
from hat_ros.geometry import lie
from hat_ros.geometry.linear import turn_between
from hat_ros.motion.feature import FeatureSlam, bulge, depth_beside
from hat_ros.types import Camera, Detection, Frame


def config(masked=True, **feature):
    return HatConfig(
        slam=SlamConfig(masked=masked, feature=FeatureSlamConfig(**feature)), prior=PriorConfig(enabled=True)
    )


def run(slam, clip, prior=lambda index: None, first=0, last=None):
    span = range(first, len(clip.frames) if last is None else last)
    return [slam.update(clip.frames[i], clip.detections[i], prior(i)) for i in span]


def blank(frame, level):
    return Frame(frame.stamp_ns, np.full_like(frame.rgb, level), frame.camera)


@pytest.fixture(scope="module")
def clip():
    return speckled_clip(45)


@pytest.fixture(scope="module")
def motions(clip):
    return run(FeatureSlam(config(), None), clip)


@pytest.fixture(scope="module")
def motions_with_prior(clip):
    return run(FeatureSlam(config(), clip.target), clip, clip.prior)


def test_planted_motion_is_recovered_up_to_similarity(clip, motions):
    assert motions[0].valid
    assert all(motion.valid for motion in motions[5:])
    assert {motion.epoch for motion in motions} == {0}
    assert np.median(turn_errors_deg(motions, clip.T_cam_target)[20:]) < 0.1
    assert np.median(turn_errors_deg(motions, clip.T_cam_target, step=10)[20:]) < 1.0


def test_priors_bring_the_structure_sooner(clip, motions_with_prior):
    assert np.median(turn_errors_deg(motions_with_prior, clip.T_cam_target)[10:]) < 0.05
    assert np.median(turn_errors_deg(motions_with_prior, clip.T_cam_target, step=10)[10:]) < 0.5


def test_camera_keeps_its_place_in_the_target_frame(clip, motions_with_prior):
    """A point fixed in the SLAM frame projects onto the target all along, at a distance in proportion."""
    late = range(15, len(clip.frames))
    rows = [np.c_[lie.inverse(motions_with_prior[i].T_slam_cam)[:3], -clip.T_cam_target[i, :3, 3]] for i in late]
    A = np.concatenate(rows)
    s = np.linalg.svd(A / np.abs(A).max(axis=0), compute_uv=False)
    assert s[-1] / s[-2] < 0.05


def test_uncertainty_is_finite_and_falls_as_structure_emerges(motions):
    sigma = np.array([motion.sigma_rad for motion in motions if motion.valid][1:])
    assert np.isfinite(sigma).all()
    assert (sigma > 0).all()
    assert np.median(sigma[20:]) < 0.7 * sigma[0]


def test_an_uncertain_step_is_no_motion(clip, motions):
    strict = run(FeatureSlam(config(max_step_sigma_deg=0.05), None), clip, last=10)
    assert not any(motion.valid for motion in strict[1:])
    assert strict[-1].epoch == motions[9].epoch


def test_a_later_frame_or_prior_never_changes_an_earlier_output(clip, motions_with_prior):
    slam = FeatureSlam(config(), clip.target)
    early = run(slam, clip, clip.prior, last=20)
    wild = lie.so3_exp(np.array([0.0, 3.0, 0.0]))
    run(slam, clip, lambda i: clip.prior(i, turned=wild), first=20, last=25)
    for now, then in zip(early, motions_with_prior, strict=False):
        assert now.pose_row.tobytes() == then.pose_row.tobytes()


def test_wrong_priors_do_not_destroy_the_increments(clip):
    flips = (lie.so3_exp(np.pi * axis) for axis in np.eye(3))
    for flip in flips:
        found = run(FeatureSlam(config(), clip.target), clip, lambda i, flip=flip: clip.prior(i, turned=flip))
        assert np.median(turn_errors_deg(found, clip.T_cam_target)[20:]) < 0.15


def test_priors_that_start_late_keep_gauge_and_epoch(clip):
    found = run(FeatureSlam(config(), clip.target), clip, lambda i: clip.prior(i) if i >= 25 else None)
    assert {motion.epoch for motion in found} == {0}
    assert np.nanmax(turn_errors_deg(found, clip.T_cam_target)[20:]) < 0.5
    place = np.stack([motion.T_slam_cam[:3, 3] for motion in found])
    assert np.linalg.norm(np.diff(place, axis=0), axis=1)[20:].max() < 0.1


def test_unhealthy_priors_are_not_used(clip, motions):
    found = run(FeatureSlam(config(), clip.target), clip, lambda i: clip.prior(i, healthy=False))
    assert [motion.pose_row.tobytes() for motion in found] == [motion.pose_row.tobytes() for motion in motions]


def test_where_the_tracks_leave_the_relief_open_the_fused_turn_decides(clip, monkeypatch):
    slam = FeatureSlam(config(), clip.target)
    run(slam, clip, last=16)
    window = slam._epoch._window
    monkeypatch.setattr(window, "_descend", lambda state, problem, n: (window.cost, window.covariance))
    since_ns, before = window.stamps_ns[-5], window.R.copy()
    own = turn_between(window.R[-1], window.R[-5])
    for opinion in (None, own, own * 1.3, np.zeros(3)):
        window.challenge_structure(since_ns, opinion)
        np.testing.assert_array_equal(window.R, before)
    reversed_turn = own * [-1, -1, 1]
    window.challenge_structure(since_ns, reversed_turn)
    now = turn_between(window.R[-1], window.R[-5])
    assert np.linalg.norm(now - reversed_turn) < 0.5 * np.linalg.norm(own)


def test_use_prior_false_ignores_priors(clip, motions):
    found = run(FeatureSlam(config(use_prior=False), clip.target), clip, clip.prior, last=15)
    assert [motion.pose_row.tobytes() for motion in found] == [motion.pose_row.tobytes() for motion in motions[:15]]


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_blank_image_gives_no_motion(clip, level):
    slam = FeatureSlam(config(), None)
    assert not slam.update(blank(clip.frames[0], level), clip.detections[0], None).valid


def test_short_blindness_keeps_the_epoch_and_the_gauge(clip):
    slam = FeatureSlam(config(), clip.target)
    before = run(slam, clip, clip.prior, last=20)
    hidden = slam.update(clip.frames[20], None, clip.prior(20))
    after = run(slam, clip, clip.prior, first=21)
    assert not hidden.valid
    assert np.isnan(hidden.pose_row).all()
    assert {motion.epoch for motion in before + after} == {0}
    assert np.nanmedian(turn_errors_deg(before + [hidden] + after, clip.T_cam_target, step=2)[17:22]) < 0.3


def test_long_blindness_starts_a_new_epoch(clip):
    slam = FeatureSlam(config(), None)
    run(slam, clip, last=15)
    lost = [slam.update(blank(clip.frames[i], 0), clip.detections[i], None) for i in range(15, 20)]
    after = run(slam, clip, first=20)
    assert not any(motion.valid for motion in lost)
    assert after[0].valid
    assert {motion.epoch for motion in after} == {1}


def test_reset_starts_a_new_epoch_but_only_after_motion(clip):
    slam = FeatureSlam(config(), None)
    slam.reset()
    assert run(slam, clip, last=1)[0].epoch == 0
    slam.reset()
    assert run(slam, clip, first=1, last=2)[0].epoch == 1


def test_another_camera_starts_a_new_epoch(clip):
    slam = FeatureSlam(config(), None)
    run(slam, clip, last=3)
    K = CAMERA.K.copy()
    K[0, 0] *= 1.1
    frame = Frame(4 * FRAME_NS, clip.frames[3].rgb, Camera(K, CAMERA.width, CAMERA.height))
    assert slam.update(frame, clip.detections[3], None).epoch == 1


def test_a_bright_background_outside_the_mask_does_not_leak(clip):
    """The stage blacks it out; what remains follows the target and not the clouds."""
    cloudy = speckled_clip(35, backdrop=True)
    slam = FeatureSlam(config(), cloudy.target)
    found = []
    for i, (frame, detection) in enumerate(zip(cloudy.frames, cloudy.detections, strict=True)):
        masked = Frame(frame.stamp_ns, frame.rgb * detection.mask[..., None], frame.camera)
        found.append(slam.update(masked, detection, cloudy.prior(i)))
    assert np.median(turn_errors_deg(found, cloudy.T_cam_target)[12:]) < 0.1


@pytest.fixture(scope="module")
def scene():
    return speckled_clip(30, wall=True, step_deg=1.0)


def test_a_static_scene_needs_neither_mask_nor_detection(scene):
    slam = FeatureSlam(config(masked=False), None)
    found = [slam.update(frame, None, None) for frame in scene.frames]
    assert all(motion.valid for motion in found[5:])
    assert np.nanmedian(turn_errors_deg(found, scene.T_cam_target)[12:]) < 0.1


def test_priors_of_a_small_part_are_not_used_on_a_whole_scene(scene):
    with_prior = run(FeatureSlam(config(masked=False), scene.target), scene, scene.prior, last=12)
    without = run(FeatureSlam(config(masked=False), None), scene, last=12)
    assert [a.pose_row.tobytes() for a in with_prior] == [b.pose_row.tobytes() for b in without]


def test_a_stretch_of_strange_masks_is_survived(clip):
    slam = FeatureSlam(config(), None)
    run(slam, clip, last=10)
    speck = np.zeros_like(clip.detections[10].mask)
    speck[5, 5] = True
    assert not slam.update(clip.frames[10], Detection(speck), None).valid
    assert slam.update(clip.frames[11], clip.detections[11], None).epoch in (0, 1)


def test_same_input_gives_the_same_bytes(clip, motions_with_prior):
    again = run(FeatureSlam(config(), clip.target), clip, clip.prior, last=25)
    for now, then in zip(again, motions_with_prior, strict=False):
        assert now.pose_row.tobytes() == then.pose_row.tobytes()


def test_memory_does_not_grow(clip):
    """Sixteen passes to and fro: what is held after the last is what was held after the third."""
    slam = FeatureSlam(config(max_points=60, window_frames=8), clip.target)
    to_and_fro = [*range(20), *range(18, 0, -1)]
    held = []
    tracemalloc.start()
    for lap in range(16):
        for step, i in enumerate(to_and_fro):
            stamp_ns = (lap * len(to_and_fro) + step + 1) * FRAME_NS
            slam.update(Frame(stamp_ns, clip.frames[i].rgb, CAMERA), clip.detections[i], None)
        # Else what is held depends on when the collector last ran, and on how many of its 4,096 places Python's cache
        # of looked-up attributes has filled: Numba looks the fields of a tuple up by a new text each time.
        gc.collect()
        sys._clear_type_cache()
        held.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert max(held[8:]) < max(held[2:8]) + 2_000  # of which ``held`` itself takes 500; a frame's track takes more


def test_bulge_is_highest_in_the_middle_and_low_at_the_edge():
    region = np.zeros((60, 80), np.uint8)
    region[10:50, 10:70] = 1
    height = bulge(region, np.array([[40.0, 30.0], [11.0, 30.0], [25.0, 30.0]]))
    assert height[0] > height[2] > height[1]
    assert (height >= 0).all()
    assert (height <= 1).all()


def test_new_points_start_at_the_depth_of_the_nearest_known_ones():
    xy_known = np.random.default_rng(4).uniform(0, 100, (60, 2))
    z_known = np.where(xy_known[:, 0] < 50, 1.0, 3.0)
    z, relief = depth_beside(np.array([[20.0, 50.0], [80.0, 50.0], xy_known[0]]), xy_known, z_known)
    np.testing.assert_allclose(z[:2], [1.0, 3.0])
    assert relief >= 0.0
    assert depth_beside(np.zeros((1, 2)), np.ones((2, 2)), np.array([2.0, 4.0]))[0] == pytest.approx(3.0)
