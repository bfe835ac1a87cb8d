import cv2
import numpy as np
import pytest

from hat_ros.segmentation.boundary import refine_outline


def disc(radius, center=(60.3, 55.6), inside=(200, 150, 40), outside=(90, 100, 120), noise=0.0):
    """A disc with exact coverage at its rim: (picture, truth)."""
    y, x = np.mgrid[0:120, 0:120]
    distance = np.hypot(x - center[0], y - center[1])
    cover = np.clip(radius - distance + 0.5, 0, 1)[..., None]
    picture = cover * np.array(inside) + (1 - cover) * np.array(outside)
    picture = picture + np.random.default_rng(0).normal(size=picture.shape) * noise
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8), (distance < radius).astype(np.uint8)


@pytest.mark.parametrize("off", [-3, -1, 2, 3])
@pytest.mark.parametrize("noise", [0.0, 8.0])
def test_a_wrong_outline_moves_to_the_edge_without_bias(off, noise):
    picture, truth = disc(35.0, noise=noise)
    _, start = disc(35.0 + off)
    found = refine_outline(picture, start, 4, 8.0)
    radius_error = np.sqrt(found.sum() / np.pi) - np.sqrt(truth.sum() / np.pi)
    assert abs(radius_error) < 0.1
    assert np.count_nonzero(found != truth) < 0.2 * 2 * np.pi * 35


@pytest.mark.parametrize("gain", [0.3, 1.0])
def test_contrast_does_not_move_the_edge(gain):
    inside, outside = np.array((200, 150, 40)) * gain, np.array((90, 100, 120)) * gain
    picture, truth = disc(30.0, inside=inside, outside=outside)
    assert np.count_nonzero(refine_outline(picture, disc(31.5)[1], 3, 8.0) != truth) < 12


def test_without_contrast_nothing_moves():
    picture, _ = disc(30.0, inside=(100, 100, 100), outside=(102, 101, 100))
    start = disc(33.0)[1]
    assert np.count_nonzero(refine_outline(picture, start, 3, 8.0) != start) == 0


def test_pixels_outside_the_band_never_change():
    picture, _ = disc(20.0)
    start = disc(40.0)[1]
    found = refine_outline(picture, start, 3, 8.0)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    band = cv2.dilate(start, kernel) != cv2.erode(start, kernel)
    assert np.array_equal(found[~band], start[~band])


@pytest.mark.parametrize("shape", [(-1, 1, 2), (-1, 2)], ids=["OpenCV 4", "OpenCV 5"])
def test_both_shapes_of_a_point_list_give_the_same_outline(shape, monkeypatch):
    picture, _ = disc(35.0)
    _, start = disc(37.0)
    expected = refine_outline(picture, start, 4, 8.0)
    find = cv2.findNonZero
    monkeypatch.setattr(cv2, "findNonZero", lambda image: find(image).reshape(shape))
    assert (refine_outline(picture, start, 4, 8.0) == expected).all()
    assert (expected != start).any()
