"""Point tracks on images of known displacement."""

import cv2
import numpy as np
import pytest

from hat_ros.motion.tracks import PointTracks, clear_disks, detect, follow


@pytest.fixture(scope="module")
def texture():
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.uniform(0, 255, (200, 260)), (0, 0), 2.5)
    return np.clip(128 + 8 * (image - image.mean()), 0, 255).astype(np.uint8)


def moved(image, dx, dy, angle_deg=0.0):
    height, width = image.shape
    A = cv2.getRotationMatrix2D((width / 2, height / 2), angle_deg, 1.0)
    A[:, 2] += [dx, dy]
    return cv2.warpAffine(image, A, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), A


def inside(image, margin=24):
    region = np.zeros_like(image)
    region[margin:-margin, margin:-margin] = 1
    return region


@pytest.mark.parametrize(
    ("dx", "dy", "angle", "error_px"), [(0.3, -0.7, 0, 0.1), (5.25, 3.5, 0, 0.1), (0, 0, 4.0, 0.25)]
)
def test_points_are_followed_to_a_fraction_of_a_pixel(texture, dx, dy, angle, error_px):
    after, A = moved(texture, dx, dy, angle)
    xy = detect(texture, inside(texture), np.zeros((0, 2)), 80, 6.0)
    found_xy, found = follow(texture, after, xy, xy.copy())
    true = xy @ A[:, :2].T + A[:, 2]
    assert found.mean() > 0.9
    assert np.median(np.linalg.norm(found_xy - true, axis=1)[found]) < error_px


def test_a_patch_that_vanishes_is_not_found(texture):
    after = texture.copy()
    after[60:140, 80:180] = 128
    xy = np.array([[130.0, 100.0], [40.0, 40.0]])
    _, found = follow(texture, after, xy, xy.copy())
    assert found.tolist() == [False, True]


def test_a_guess_outside_the_image_is_no_error(texture):
    xy = np.array([[100.0, 100.0]])
    follow(texture, texture, xy, np.array([[-500.0, 9000.0]]))


@pytest.mark.parametrize("level", [0, 128, 255])
def test_blank_images_have_no_corners(level):
    blank = np.full((120, 160), level, np.uint8)
    assert len(detect(blank, np.ones_like(blank), np.zeros((0, 2)), 50, 4.0)) == 0


def test_corners_lie_in_the_region_and_keep_their_distance(texture):
    region = inside(texture, 50)
    taken = detect(texture, region, np.zeros((0, 2)), 20, 8.0)
    new = detect(texture, region, taken, 30, 8.0)
    assert (region[new[:, 1].astype(int), new[:, 0].astype(int)] > 0).all()
    everything = np.concatenate([taken, new])
    apart = np.linalg.norm(everything[:, None] - everything, axis=-1) + 1e9 * np.eye(len(everything))
    assert apart.min() > 6.5


def test_slots_are_reused_but_identities_never_are(texture):
    tracks = PointTracks(40, 6.0)
    first = tracks.replenish(texture, inside(texture))
    before = tracks.track_id.copy()
    tracks.alive[first[:20]] = False
    again = tracks.replenish(texture, inside(texture))
    assert set(again) <= set(first[:20])
    assert set(tracks.track_id[again]).isdisjoint(before)


def test_points_that_leave_the_region_are_dropped(texture):
    tracks = PointTracks(40, 6.0)
    tracks.replenish(texture, inside(texture))
    region = inside(texture)
    region[:, : texture.shape[1] // 2] = 0
    tracks.advance(texture, region, tracks.xy.copy())
    assert tracks.alive.any()
    assert (tracks.xy[tracks.alive, 0] >= texture.shape[1] // 2 - 0.5).all()


def test_disks_are_cleared_as_far_as_they_lie_on_the_mask():
    rng = np.random.default_rng(1)
    for _ in range(50):
        height, width = rng.integers(5, 90, 2)
        radius = int(rng.integers(1, 30))
        centers = rng.integers(-40, 130, (rng.integers(0, 12), 2))
        disk = cv2.circle(np.zeros((2 * radius + 1, 2 * radius + 1), np.uint8), (radius, radius), radius, 1, -1)
        mask = np.full((height, width), 255, np.uint8)
        expected = mask.copy()
        for center in centers:
            cv2.circle(expected, center.tolist(), radius, 0, -1)
        clear_disks(mask, centers, disk)
        np.testing.assert_array_equal(mask, expected)
