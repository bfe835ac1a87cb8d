import numpy as np
import pytest
from shape_scene import CAMERA, random_pose, spacecraft, sunlit_picture

from hat_ros.geometry import lie
from hat_ros.refinement.mask_field import MaskField
from hat_ros.refinement.sunlight import LightField, SunMatcher, brightness
from hat_ros.refinement.view import TargetViewer, contour_lines
from hat_ros.types import Frame

SUNS = {"beside": (-1.0, 0.2, -0.3), "behind the camera": (0.2, -0.3, -1.0), "ahead": (0.7, 0.6, 0.3)}


@pytest.fixture(scope="module")
def viewer():
    return TargetViewer(spacecraft())


@pytest.fixture(scope="module")
def matcher(viewer):
    return SunMatcher(viewer)


def light(matcher, viewer, T, frame, mask, side_px=96):
    return matcher.match(viewer.view(T, CAMERA, side_px), LightField(frame.rgb, mask))


def turned(T, rotvec):
    out = T.copy()
    out[:3, :3] = T[:3, :3] @ lie.so3_exp(np.array(rotvec))
    return out


@pytest.mark.parametrize("sun", SUNS.values(), ids=SUNS)
@pytest.mark.parametrize("seed", range(3))
def test_the_true_pose_explains_light_and_shadow_best(viewer, matcher, sun, seed):
    T_true = random_pose(np.random.default_rng(seed), viewer.target)
    frame, mask = sunlit_picture(viewer.target, T_true, sun)
    truth = light(matcher, viewer, T_true, frame, mask)
    for rotvec in ((np.pi, 0, 0), (0, np.pi, 0), (0, 0, np.pi), (0.8, 0.0, 0.6)):
        assert truth.distance < light(matcher, viewer, turned(T_true, rotvec), frame, mask).distance


def test_the_sun_is_found_where_it_is(viewer, matcher):
    errors = []
    for seed in range(6):
        T_true = random_pose(np.random.default_rng(seed), viewer.target)
        frame, mask = sunlit_picture(viewer.target, T_true, SUNS["beside"])
        found = light(matcher, viewer, T_true, frame, mask).to_sun_cam
        errors.append(np.degrees(np.arccos(found @ np.array(SUNS["beside"]) / np.linalg.norm(SUNS["beside"]))))
    assert np.median(errors) < 20


def test_exposure_does_not_matter(viewer, matcher):
    T_true = random_pose(np.random.default_rng(1), viewer.target)
    distances = []
    for exposure in (0.4, 0.8):
        frame, mask = sunlit_picture(viewer.target, T_true, SUNS["beside"], exposure)
        distances.append(light(matcher, viewer, T_true, frame, mask).distance)
    assert distances[0] == pytest.approx(distances[1], abs=0.03)


def test_light_beside_the_silhouette_counts_against_a_pose(viewer, matcher):
    T_true = random_pose(np.random.default_rng(2), viewer.target)
    frame, mask = sunlit_picture(viewer.target, T_true, SUNS["beside"])
    beside = T_true.copy()
    beside[0, 3] += 0.5
    truth = light(matcher, viewer, T_true, frame, mask)
    assert light(matcher, viewer, beside, frame, mask).distance > truth.distance + 0.1


def test_a_black_image_explains_nothing(viewer, matcher):
    T = random_pose(np.random.default_rng(2), viewer.target)
    frame = Frame(1, np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8), CAMERA)
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    mask[100:120, 100:120] = True
    assert light(matcher, viewer, T, frame, mask).distance == 1.0


def test_a_target_beside_the_image_has_no_light(viewer, matcher):
    T = random_pose(np.random.default_rng(2), viewer.target)
    frame, mask = sunlit_picture(viewer.target, T, SUNS["beside"])
    view = viewer.view(T, CAMERA, 96).shifted(np.array([2.0 * CAMERA.width, 0.0]))
    assert matcher.match(view, LightField(frame.rgb, mask)) is None


@pytest.mark.parametrize("seed", range(3))
def test_the_size_of_the_view_does_not_matter(viewer, matcher, seed):
    T_true = random_pose(np.random.default_rng(seed), viewer.target)
    frame, mask = sunlit_picture(viewer.target, T_true, SUNS["beside"])
    coarse, fine = (light(matcher, viewer, T_true, frame, mask, side_px).distance for side_px in (96, 200))
    assert coarse == pytest.approx(fine, abs=0.05)


def test_a_view_put_in_sunlight_is_the_view_cast_in_it(viewer):
    T, sun = random_pose(np.random.default_rng(5), viewer.target), np.array(SUNS["beside"])
    at_once = viewer.view(T, CAMERA, 96, sun)
    later = viewer.in_sunlight(viewer.view(T, CAMERA, 96), sun)
    np.testing.assert_array_equal(at_once.lit, later.lit)


def test_brightness_grows_with_the_cosine():
    values = brightness(np.linspace(0, 1, 20, dtype=np.float32))
    assert (np.diff(values) > 0).all()
    assert values[0] > 0


def test_what_faces_the_sun_is_lit_and_what_it_does_not_reach_is_no_contour(viewer):
    T = random_pose(np.random.default_rng(4), viewer.target)
    without = viewer.view(T, CAMERA, 96)
    front = viewer.view(T, CAMERA, 96, np.array([0.0, 0.0, -1.0]))
    back = viewer.view(T, CAMERA, 96, np.array([0.0, 0.0, 1.0]))
    side = viewer.view(T, CAMERA, 96, np.array([-1.0, 0.0, -0.2]))
    assert without.lit is None
    for view in (front, back, side):
        np.testing.assert_array_equal(view.mask, without.mask)
        assert not (view.lit & ~view.mask).any()
    share = [np.count_nonzero(v.lit) / np.count_nonzero(v.mask) for v in (front, side, back)]
    assert share[0] > 0.9
    assert share[2] < 0.02
    assert share[0] > share[1] > share[2]
    n_all = len(contour_lines(without, 300).points_m)
    assert 0 < len(contour_lines(side, 300).points_m) < n_all


def test_nothing_is_missed_in_the_shadow(viewer):
    sun = np.array(SUNS["beside"])
    T = random_pose(np.random.default_rng(5), viewer.target)
    frame, _ = sunlit_picture(viewer.target, T, sun)
    luma = frame.rgb.max(axis=2)
    field = MaskField(luma > 40)
    shadowless = field.compare(viewer.view(T, CAMERA, 160), luma)
    shadowed = field.compare(viewer.view(T, CAMERA, 160, sun), luma)
    assert shadowed.hidden < 0.4 * shadowless.hidden
    assert shadowed.extra == shadowless.extra
    assert shadowed.union_share > shadowless.union_share
