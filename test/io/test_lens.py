"""A lens is undone: the picture of the pinhole camera comes back, and the mask with it."""

from __future__ import annotations

import numpy as np
import pytest
from camera_info import LENSES, K, distorted_points, info, smooth_picture, through_lens

from hat_ros.errors import FrameError
from hat_ros.io.calibration import calibration_from
from hat_ros.io.lens import MODELS, Lens
from hat_ros.types import Camera

CAMERA = Camera(K, 320, 240)


@pytest.mark.parametrize("model", LENSES)
def test_the_picture_of_the_pinhole_camera_comes_back(model):
    picture = smooth_picture()
    raw = through_lens(picture, K, model, LENSES[model])
    lens = calibration_from(info(d=LENSES[model], model=model), "/image_raw", "auto").lens
    found = lens.undistort(raw)
    seen = lens.undistort(np.full_like(raw, 255)).min(axis=-1) == 255
    inside = np.zeros_like(seen)
    inside[40:-40, 50:-50] = True
    assert seen[inside].all()
    assert np.abs(raw.astype(int) - picture)[inside].mean() > 2, "the lens must matter"
    assert np.abs(found.astype(int) - picture)[inside].mean() < 0.6


@pytest.mark.parametrize("model", LENSES)
def test_a_mask_keeps_its_values_and_moves_with_the_picture(model):
    v, u = np.mgrid[:240, :320]
    square = (abs(u - 200) < 60) & (abs(v - 110) < 50)
    raw = through_lens(square.astype(np.uint8) * 255, K, model, LENSES[model])
    lens = Lens.of(model, np.array(LENSES[model]), CAMERA)
    found = lens.undistort_mask(np.where(raw > 127, 255, 0).astype(np.uint8))
    assert set(np.unique(found)) == {0, 255}
    union = square | (found == 255)
    assert (square & (found == 255)).sum() / union.sum() > 0.97


@pytest.mark.parametrize("name", MODELS)
def test_every_name_is_read_and_short_lists_of_coefficients_are_filled(name):
    lens = Lens.of(name, np.array([0.1, 0.01]), CAMERA)
    assert lens.undistort(smooth_picture()).shape == (240, 320, 3)


def test_beyond_the_radius_at_which_the_polynomial_turns_back_is_black():
    # r (1 - 0.6 r^2) has its largest value at r = 0.745; a corner lies at 0.66, beside the optical axis twice as far.
    wide = Camera(np.array([[150.0, 0, 160], [0, 150, 120], [0, 0, 1]]), 320, 240)
    lens = Lens.of("plumb_bob", np.array([-0.6, 0.0, 0.0, 0.0]), wide)
    found = lens.undistort(np.full((240, 320, 3), 200, np.uint8))[..., 0]
    v, u = np.mgrid[:240, :320]
    radius = np.hypot(u - 160, v - 120) / 150
    turn = 1 / np.sqrt(3 * 0.6)
    assert (found[radius > turn + 0.02] == 0).all()
    assert (found[radius < turn - 0.02] == 200).all()


@pytest.mark.parametrize("model", LENSES)
def test_rays_stay_in_the_optical_frame(model):
    """A spot seen by the lens lands where the pinhole camera projects its ray."""
    x, y = 0.21, -0.13
    raw_x, raw_y = distorted_points(np.float64(x), np.float64(y), model, LENSES[model])
    v, u = np.mgrid[:240, :320]
    at = K @ [raw_x, raw_y, 1.0]
    spot = 255 * np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / 18.0)
    found = Lens.of(model, np.array(LENSES[model]), CAMERA).undistort(np.dstack([spot] * 3).astype(np.uint8))[..., 0]
    weight = found.astype(float)
    centre = (weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()
    assert centre == pytest.approx((K @ [x, y, 1.0])[:2], abs=0.25)


@pytest.mark.parametrize(
    ("model", "d"),
    [
        ("plumb_bob", (-40.0, 0, 0, 0, 0)),
        ("plumb_bob", (1e300, -1e300, 0, 0, 0)),
        ("rational_polynomial", (0.0, 0, 0, 0, 0, 60.0, 0, 0)),
        ("equidistant", (-30.0, 0, 0, 0)),
    ],
)
def test_coefficients_that_are_no_lens_are_one_sentence(model, d):
    lens = Lens.of(model, np.array(d), CAMERA)
    with pytest.raises(FrameError, match="is no lens of this image"):
        lens.undistort(smooth_picture())


def test_any_coefficients_give_a_picture_or_a_sentence():
    rng = np.random.default_rng(0)
    for _ in range(300):
        model = str(rng.choice(list(MODELS)))
        d = rng.normal(size=4) * rng.choice([1e-3, 0.1, 3.0, 1e6])
        try:
            assert Lens.of(model, d, CAMERA).undistort(smooth_picture()).shape == (240, 320, 3)
        except FrameError:
            continue
