import cv2
import numpy as np
import pytest
import trimesh
from shape_scene import CAMERA, picture, pose_errors, random_pose, spacecraft, sunlit_picture

from hat_ros.config import RefinementConfig
from hat_ros.geometry import lie
from hat_ros.refinement.contour_refiner import ContourRefiner
from hat_ros.refinement.sunlight import Sunlight, SunMatcher
from hat_ros.target.loading import target_from_scene
from hat_ros.tracking.image_fusion import is_supported
from hat_ros.types import Detection, Frame, RotationPrior

ENABLED = RefinementConfig(enabled=True)


@pytest.fixture(scope="module")
def target():
    return spacecraft()


@pytest.fixture(scope="module")
def refiner(target):
    return ContourRefiner(ENABLED, target)


def perturbed(T, rng, angle_deg, shift):
    axis = rng.normal(size=3)
    out = T.copy()
    out[:3, :3] = lie.so3_exp(np.radians(angle_deg) * axis / np.linalg.norm(axis)) @ T[:3, :3]
    out[:3, 3] *= 1 + rng.uniform(-shift, shift)
    return out


@pytest.mark.parametrize("seed", range(5))
def test_a_perturbed_pose_converges(refiner, target, seed):
    rng = np.random.default_rng(seed)
    T_true = random_pose(rng, target)
    frame, mask = picture(target, T_true)
    refined = refiner.refine(frame, Detection(mask), perturbed(T_true, rng, 4.0, 0.03))
    turn, shift = pose_errors(refined.T_cam_target, T_true)
    assert turn < 1.0
    assert shift < 0.005
    assert refined.overlap > 0.93
    assert refined.support > 0.9


@pytest.mark.parametrize("seed", range(4))
def test_what_lies_in_shadow_does_not_drag_the_pose(refiner, target, seed):
    rng = np.random.default_rng(seed)
    T_true = random_pose(rng, target)
    frame, mask = sunlit_picture(target, T_true, (-1.0, 0.4, -0.1))
    refined = refiner.refine(frame, Detection(mask), perturbed(T_true, rng, 3.0, 0.02))
    turn, shift = pose_errors(refined.T_cam_target, T_true)
    assert turn < 3.0
    assert shift < 0.02


@pytest.fixture(scope="module")
def barrel():
    """A round body, with a box that gives it a front."""
    tube = trimesh.creation.cylinder(0.5, 1.6)
    box = trimesh.creation.box((0.5, 0.4, 0.3), transform=lie.transform(np.eye(3), [0.45, 0.0, 0.7]))
    for mesh in (tube, box):
        mesh.visual.face_colors = np.tile([170, 170, 170, 255], (len(mesh.faces), 1))
    return target_from_scene(trimesh.Scene([tube, box]), "barrel")


@pytest.mark.parametrize(
    ("to_sun", "in_shadow", "start"), [((-1.0, 0.3, -1.0), (0.1, 0.2), 1.0), ((0.8, 0.2, -1.2), (0.04, 0.08), 1.03)]
)
def test_a_dark_rim_makes_no_round_body_small_and_far_frame_after_frame(barrel, to_sun, in_shadow, start):
    """Nor does it stay so once it is: a pose too small and far misses less of its shadow than there is."""
    T_true = random_pose(np.random.default_rng(6), barrel)
    frame, silhouette = sunlit_picture(barrel, T_true, to_sun)
    lit = silhouette & (frame.rgb.max(axis=2) > 12)
    assert in_shadow[0] < 1.0 - lit.sum() / silhouette.sum() < in_shadow[1]
    refiner, T = ContourRefiner(ENABLED, barrel), T_true.copy()
    T[:3, 3] *= start
    for _ in range(10):
        T = refiner.refine(frame, Detection(lit), T).T_cam_target
    assert pose_errors(T, T_true)[0] < 2.0
    assert T[2, 3] / T_true[2, 3] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(("seed", "to_sun"), [(1, (-0.5, 0.2, 1.0)), (5, (0.0, 0.3, 1.0))])
def test_a_sun_that_lights_hardly_any_contour_is_not_used(refiner, target, monkeypatch, seed, to_sun):
    T_true = random_pose(np.random.default_rng(seed), target)
    frame, mask = picture(target, T_true)
    unlit = mask & (np.cumsum(mask.sum(axis=0)) < 0.1 * mask.sum())  # its left tenth, black on black
    rgb = frame.rgb.copy()
    rgb[unlit] = 0
    monkeypatch.setattr(SunMatcher, "match", lambda *_: Sunlight(0.0, np.array(to_sun)))
    start = lie.transform(lie.so3_exp([0.02, 0.018, 0.022]) @ T_true[:3, :3], 1.01 * T_true[:3, 3])
    refined = refiner.refine(Frame(frame.stamp_ns, rgb, frame.camera), Detection(mask & ~unlit), start)
    turn, shift = pose_errors(refined.T_cam_target, T_true)
    assert turn < 1.0
    assert shift < 0.005


@pytest.mark.parametrize("wide", [False, True])
def test_what_is_known_of_the_rotation_holds_it_about_that_axis_alone(refiner, target, wide):
    """Also over several rounds: what is known refers to the expected rotation, not to each round's start."""
    rng = np.random.default_rng(5)
    T_true = random_pose(rng, target)
    frame, mask = picture(target, T_true)
    axis, other = np.array([0.0, 0.6, 0.8]), np.array([0.0, -0.8, 0.6])
    expected = lie.so3_exp(np.radians(1.5) * (axis + other)) @ T_true[:3, :3]
    start = lie.transform(expected, T_true[:3, 3] * (1.04 if wide else 1.0))
    known = RotationPrior(expected, 1e9 * np.outer(axis, axis))
    held = refiner.refine(frame, Detection(mask), start, known)
    moved = np.degrees(lie.so3_log(held.T_cam_target[:3, :3] @ expected.T))
    assert abs(moved @ axis) < 0.02
    assert np.linalg.norm(moved) > 0.3


@pytest.mark.parametrize("background", [0, 120])
def test_the_image_alone_is_enough_for_a_small_correction(refiner, target, background):
    rng = np.random.default_rng(21)
    T_true = random_pose(rng, target)
    frame, _ = picture(target, T_true, background=background)
    refined = refiner.refine(frame, None, perturbed(T_true, rng, 2.0, 0.02))
    turn, shift = pose_errors(refined.T_cam_target, T_true)
    assert turn < 1.5
    assert shift < 0.01
    assert np.isnan(refined.overlap)


@pytest.mark.parametrize("size", [3, 5])
def test_the_outline_bias_of_a_mask_does_not_move_the_pose(refiner, target, size):
    rng = np.random.default_rng(5)
    T_true = random_pose(rng, target)
    frame, mask = picture(target, T_true)
    large = cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    refined = refiner.refine(frame, Detection(large), perturbed(T_true, rng, 1.0, 0.01))
    assert pose_errors(refined.T_cam_target, T_true)[1] < 0.006


def test_the_more_a_mask_lacks_the_less_certain_is_the_pose(refiner, target):
    rng = np.random.default_rng(11)
    T_true = random_pose(rng, target)
    frame, mask = picture(target, T_true)
    columns = np.flatnonzero(mask.any(axis=0))
    variances = []
    for lacking in (0.0, 0.15, 0.3):
        part = mask.copy()
        part[:, columns[round((1.0 - lacking) * len(columns)) :]] = False
        variances.append(np.trace(refiner.refine(frame, Detection(part), T_true).covariance[3:, 3:]))
    assert variances[0] < variances[1] < variances[2]


def test_a_target_leaving_the_image_is_still_refined(refiner, target):
    rng = np.random.default_rng(7)
    T_true = random_pose(rng, target, range_m=(5.0, 5.2))
    T_true[0, 3] += 1.3
    frame, mask = picture(target, T_true)
    assert Detection(mask).touches_border()
    refined = refiner.refine(frame, Detection(mask), perturbed(T_true, rng, 2.0, 0.01))
    turn, shift = pose_errors(refined.T_cam_target, T_true)
    assert turn < 2
    assert shift < 0.01


def test_a_pose_of_another_basin_is_never_turned_into_this_one(refiner, target):
    rng = np.random.default_rng(8)
    T_true = random_pose(rng, target)
    frame, mask = picture(target, T_true)
    refined = refiner.refine(frame, Detection(mask), perturbed(T_true, rng, 60.0, 0.0))
    if refined is not None:
        assert 45 < pose_errors(refined.T_cam_target, T_true)[0] < 75


@pytest.mark.parametrize("level", [0, 255])
def test_a_blank_image_refines_nothing(refiner, target, level):
    frame = Frame(1, np.full((CAMERA.height, CAMERA.width, 3), level, np.uint8), CAMERA)
    assert refiner.refine(frame, None, random_pose(np.random.default_rng(0), target)) is None


@pytest.mark.parametrize("sigma", [0.5, 1.5, 4.0])
def test_noise_supports_no_pose(refiner, target, sigma):
    """Every line across noise has a step somewhere; a target that has left the image must not seem to be there."""
    rng = np.random.default_rng(3)
    noise = rng.normal(3.0, sigma, (CAMERA.height, CAMERA.width, 3))
    frame = Frame(1, np.clip(np.rint(noise), 0, 255).astype(np.uint8), CAMERA)
    for _ in range(5):
        refined = refiner.refine(frame, None, random_pose(rng, target))
        assert not is_supported(refined, ENABLED)


def test_a_pose_behind_the_camera_is_no_error(refiner, target):
    frame, mask = picture(target, random_pose(np.random.default_rng(0), target))
    behind = lie.transform(np.eye(3), np.array([0.0, 0.0, -5.0]))
    assert refiner.refine(frame, Detection(mask), behind) is None


def test_the_covariance_is_symmetric_positive_and_grows_with_range(refiner, target):
    sigmas = []
    for range_m in (6.0, 14.0):
        T_true = random_pose(np.random.default_rng(12), target, range_m=(range_m, range_m + 0.01))
        frame, mask = picture(target, T_true)
        covariance = refiner.refine(frame, Detection(mask), T_true).covariance
        np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9, atol=1e-18)
        assert np.linalg.eigvalsh(covariance).min() > 0
        sigmas.append(np.sqrt(np.trace(covariance[:3, :3])))
    assert sigmas[1] > sigmas[0]


def test_the_same_image_gives_the_same_bytes(target):
    rng = np.random.default_rng(3)
    T_true = random_pose(rng, target)
    frame, mask = picture(target, T_true)
    start = perturbed(T_true, rng, 2.0, 0.01)
    first, second = (ContourRefiner(ENABLED, target).refine(frame, Detection(mask), start) for _ in range(2))
    assert first.pose_row.tobytes() == second.pose_row.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()
