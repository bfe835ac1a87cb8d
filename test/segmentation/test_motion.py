import cv2
import numpy as np
import pytest

from hat_ros.segmentation.motion import MotionDetector

SIDE = (84, 112)


def ground(seed=0):
    rng = np.random.default_rng(seed)
    texture = sum(cv2.resize(rng.normal(size=(n, n, 3)), (160, 160)) * 30 for n in (6, 20, 60))
    return np.clip(texture + 120, 0, 255).astype(np.uint8)


def frames(count=9, drift=0.7, spin=0.08, target=True):
    """A drifting ground with a turning two-coloured bar on it; pictures and the bar's last mask."""
    picture, mask = ground(), None
    out = []
    for i in range(count):
        shift = np.array([[1.0, 0, -drift * i - 10], [0, 1, -10 + 0.3 * drift * i]])
        view = cv2.warpAffine(picture, shift, SIDE[::-1])
        mask = np.zeros(SIDE, np.uint8)
        if target:
            box = cv2.boxPoints(((56, 42), (44, 14), np.degrees(0.4 + spin * i))).astype(np.int32)
            cv2.fillConvexPoly(mask, box, 1)
            view[mask > 0] = (230, 60, 40)
            view[(mask > 0) & (np.arange(SIDE[1]) > 56)] = (40, 40, 60)
        out.append(view)
    return out, mask


def evidence(pictures):
    detector = MotionDetector(max(SIDE))
    for picture in pictures:
        detector.push(picture)
    return detector.evidence()


def elsewhere():
    mask = np.zeros(SIDE, np.uint8)
    mask[8:30, 5:40] = 1
    return mask


@pytest.mark.parametrize("drift", [0.0, 0.7, 2.0])
def test_the_target_moves_and_the_ground_does_not(drift):
    pictures, mask = frames(drift=drift)
    found = evidence(pictures)
    assert found.found_share(mask) > 0.75
    assert found.still_share(mask) < 0.15
    assert found.found_share(elsewhere()) < 0.2
    assert found.still_share(elsewhere()) > 0.5


def test_nothing_is_known_before_a_few_frames():
    pictures, _ = frames(2)
    assert evidence(pictures) is None


def test_ground_alone_shows_nothing():
    assert evidence(frames(target=False)[0]) is None


def test_when_everything_changes_motion_says_nothing():
    assert evidence([np.roll(ground(i), i * 31, axis=0)[: SIDE[0], : SIDE[1]] for i in range(9)]) is None


def test_a_change_of_size_starts_afresh():
    detector = MotionDetector(max(SIDE))
    for picture in frames()[0]:
        detector.push(picture)
    detector.push(np.zeros((60, 80, 3), np.uint8))
    assert detector.evidence() is None


def test_pictures_too_small_to_compare_say_nothing():
    assert evidence([picture[:10, :12] for picture in frames()[0]]) is None


def test_large_pictures_are_reduced_to_the_size_that_is_searched():
    pictures, _ = frames()
    large = [cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST) for picture in pictures]
    found = evidence(large)
    assert found.moving.shape == SIDE
    np.testing.assert_array_equal(found.moving, evidence(pictures).moving)
