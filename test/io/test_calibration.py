"""A camera_info gives the matrix of the image that there is, or one sentence that says what is missing."""

from __future__ import annotations

import numpy as np
import pytest
from camera_info import LENSES, SIZE, WIRE, K, P, info

from hat_ros.errors import FrameError
from hat_ros.io.calibration import calibration_from

BARREL = LENSES["plumb_bob"]
NO_D = (0.0,) * 5


def roi(**fields):
    found = WIRE.camera_info(1, "c", calibration_from(info(), "/image", "auto").camera).roi
    for name, value in fields.items():
        setattr(found, name, value)
    return found


@pytest.mark.parametrize("topic", ["/image", "/cam/image_raw", "/cam/image_rect"])
@pytest.mark.parametrize("rectified", ["auto", "true", "false"])
@pytest.mark.parametrize("p", [K, K * (1 + 1e-7), np.zeros((3, 3))])
def test_without_distortion_and_with_one_matrix_there_is_nothing_to_choose(topic, rectified, p):
    found = calibration_from(info(p=p), topic, rectified)
    assert np.array_equal(found.camera.K, K)
    assert (found.camera.width, found.camera.height, found.lens, found.said) == (*SIZE, None, "")


@pytest.mark.parametrize("d", [NO_D, (), BARREL])
@pytest.mark.parametrize(
    ("topic", "rectified", "matrix"),
    [
        ("/cam/image_rect", "auto", P),
        ("/cam/image_rect_color", "auto", P),
        ("/camera/infra1/image_rect_raw", "auto", P),
        ("/cam/imageRectified", "auto", P),
        ("/cam/image_undistorted", "auto", P),
        ("/cam/image_raw", "auto", K),
        ("/direct/image_raw", "auto", K),
        ("/corrected/raw", "auto", K),
        ("/image", "true", P),
        ("/image", "false", K),
        ("/cam/image_rect", "false", K),
        ("/cam/image_raw", "true", P),
    ],
)
def test_option_and_name_say_which_image_it_is(d, topic, rectified, matrix):
    found = calibration_from(info(d=d, p=P), topic, rectified)
    assert np.array_equal(found.camera.K, matrix)
    assert (found.lens is not None) == (matrix is K and any(d))
    assert ("rectified" in found.said) == (matrix is P)
    assert found.said


@pytest.mark.parametrize("d", [NO_D, BARREL])
@pytest.mark.parametrize("topic", ["/image", "/image/compressed", "/direct/image", "/correct/colour"])
def test_two_matrices_and_a_name_that_does_not_say_is_one_sentence(d, topic):
    with pytest.raises(
        FrameError,
        match=r"fx 300.*fx 280.*" + topic + r" does not tell.*set camera\.rectified \(--rectified\) to true or false",
    ):
        calibration_from(info(d=d, p=P), topic, "auto")


@pytest.mark.parametrize("p", [K, np.zeros((3, 3))])
def test_distortion_with_one_matrix_means_a_raw_image(p):
    found = calibration_from(info(d=BARREL, p=p), "/image", "auto")
    assert found.lens is not None
    assert "distortion (plumb_bob) is undone" in found.said


@pytest.mark.parametrize(("topic", "rectified"), [("/image_rect", "auto"), ("/image_raw", "true")])
def test_a_rectified_image_without_its_matrix_is_one_sentence(topic, rectified):
    with pytest.raises(FrameError, match=r"camera_info\.p is all zero.*set camera\.rectified \(--rectified\) to false"):
        calibration_from(info(d=BARREL, p=np.zeros((3, 3))), topic, rectified)


def test_a_turned_rectified_frame_is_said():
    turn = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    found = calibration_from(info(d=BARREL, p=P, r=turn.ravel()), "/image_rect", "auto")
    assert "rectified frame that r states" in found.said
    raw = calibration_from(info(d=BARREL, p=P, r=turn.ravel()), "/image_raw", "auto")
    assert np.array_equal(raw.camera.K, K)


@pytest.mark.parametrize(
    "fields", [{}, {"width": SIZE[0], "height": SIZE[1]}, {"width": SIZE[0], "height": SIZE[1], "do_rectify": True}]
)
def test_a_region_of_interest_that_is_the_whole_image_is_none(fields):
    for topic, matrix in (("/image_rect", P), ("/image_raw", K)):
        found = calibration_from(info(d=BARREL, p=P, roi=roi(**fields)), topic, "auto")
        assert np.array_equal(found.camera.K, matrix)


def test_region_and_binning_move_the_matrix_as_they_move_the_pixels():
    region = roi(x_offset=40, y_offset=20, width=200, height=160)
    found = calibration_from(info(roi=region, binning_x=2, binning_y=4), "/image", "auto").camera
    assert (found.width, found.height) == (100, 40)
    point = np.array([0.1, -0.05, 1.0])
    u, v = calibration_from(info(), "/image", "auto").camera.project(point)
    assert found.project(point) == pytest.approx([(u - 40 + 0.5) / 2 - 0.5, (v - 20 + 0.5) / 4 - 0.5])


@pytest.mark.parametrize(
    ("message", "topic", "complaint"),
    [
        (info(roi=roi(x_offset=200, width=200, height=100)), "/image", "does not lie in the image of 320x240"),
        (info(roi=roi(x_offset=1)), "/image", "does not lie in the image"),
        (
            info(d=BARREL, p=P, roi=roi(x_offset=9, y_offset=9, width=50, height=50, do_rectify=True)),
            "/image_rect",
            "rectify the whole image",
        ),
        (info(k=np.diag([-1.0, 1, 1])), "/image", r"camera_info\.k: camera matrix"),
        (info(d=BARREL, p=np.diag([-1.0, 1, 1])), "/image_rect", r"camera_info\.p: camera matrix"),
        (info(d=(np.nan,) * 5), "/image", r"camera_info\.d must be finite"),
        (info(p=np.full((3, 3), np.inf)), "/image", r"camera_info\.p must be finite"),
        (
            info(d=BARREL, model="omnidir"),
            "/image",
            r"distortion_model 'omnidir' is not supported.*rectified\) to true",
        ),
        (info(d=(0.1, 0, 0, 0), model=""), "/image", "distortion_model '' is not supported"),
        (info(d=(0.1,) * 5, model="equidistant"), "/image", "may have 4 coefficients"),
        (info(d=(0.1,) * 15), "/image", "may have 14 coefficients"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(message, topic, complaint):
    with pytest.raises(FrameError, match=complaint):
        calibration_from(message, topic, "auto")


@pytest.mark.parametrize(
    "k", [np.zeros((3, 3)), np.diag([0.0, 0, 1]), np.array([[0.0, 0, 160], [0, 0, 120], [0, 0, 1]])]
)
@pytest.mark.parametrize("d", [NO_D, BARREL])
def test_a_camera_that_is_not_calibrated_gives_none(k, d):
    assert calibration_from(info(k=k, p=np.zeros((3, 3)), d=d), "/image", "auto") is None


@pytest.mark.parametrize("model", LENSES)
def test_jitter_is_no_new_calibration_and_a_change_is(model):
    def found(share, d_share=0.0):
        d = tuple(value * (1 + d_share) for value in LENSES[model])
        return calibration_from(info(k=K * [[1 + share] * 3, [1 + share] * 3, [1] * 3], d=d, model=model), "/i", "auto")

    first = found(0.0)
    assert first.is_same(found(5e-7))
    assert first.is_same(found(0.0, 1e-7))
    assert not first.is_same(found(1e-5))
    assert not first.is_same(found(0.0, 1e-2))
    assert not first.is_same(calibration_from(info(), "/i", "auto"))
    assert not first.is_same(calibration_from(info(d=LENSES[model], model=model, size=(640, 480)), "/i", "auto"))
