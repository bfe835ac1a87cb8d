import cv2
import numpy as np
import pytest

from hat_ros.segmentation.dim import with_dim_parts
from hat_ros.segmentation.sky import lit_regions, measure_sky

NOISE = 1.4  # grey levels: single pixels and means of 3 x 3 show what is 2.5 above the sky


def picture(parts, shape=(240, 320), noise=NOISE, jpeg=True, seed=0):
    """Rectangles (x, y, w, h, grey levels) on a noisy sky of level 2, through JPEG: the sky and what is lit."""
    image = np.full(shape, 2.0, np.float32)
    for x, y, w, h, brightness in parts:
        image[y : y + h, x : x + w] += brightness
    image = cv2.GaussianBlur(image, (5, 5), 0.6) + np.random.default_rng(seed).normal(size=shape) * noise
    rgb = np.repeat(np.clip(np.rint(image), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    if jpeg:
        rgb = cv2.imdecode(cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, 95])[1], cv2.IMREAD_COLOR)
    measured = measure_sky(rgb)
    return measured, lit_regions(measured)[0]


def area(shape, x, y, w, h, margin=0):
    out = np.zeros(shape, np.uint8)
    out[y - margin : y + h + margin, x - margin : x + w + margin] = 1
    return out


@pytest.mark.parametrize("scale", [1, 3])
@pytest.mark.parametrize("brightness", [1.8, 2.6, 4.0])
def test_a_face_too_dim_for_single_pixels_is_found_as_a_whole(brightness, scale):
    """In a large image, too, which is looked at reduced."""
    shape = (240 * scale, 320 * scale)
    hull, face = np.array([100, 80, 40, 60]) * scale, np.array([140, 80, 50, 60]) * scale
    measured, lit = picture([(*hull, 120), (*face, brightness)], shape)
    found = with_dim_parts(measured, lit)
    assert found[area(shape, *face) > 0].mean() > 0.8
    outside = (area(shape, *hull, margin=2 * scale) | area(shape, *face, margin=2 * scale)) == 0
    assert found[outside].sum() <= 0.005 * found.sum()


@pytest.mark.parametrize("brightness", [12, 60, 250])
def test_nothing_is_added_around_what_is_bright(brightness):
    """Neither blur nor the halo of JPEG is a dim part."""
    measured, lit = picture([(100, 80, 60, 70, brightness)], noise=0.6)
    found = with_dim_parts(measured, lit)
    assert (found >= lit).all()
    assert found.sum() <= 1.01 * lit.sum()


def test_what_does_not_hang_on_the_target_is_not_added():
    measured, lit = picture([(100, 80, 40, 60, 120), (160, 80, 30, 60, 1.8)])
    np.testing.assert_array_equal(with_dim_parts(measured, lit)[:, 150:], 0)


@pytest.mark.parametrize("shape", [(24, 32), (20, 200), (60, 60)])
def test_small_images_keep_what_is_lit(shape):
    measured, lit = picture([(8, 8, 8, 8, 120)], shape, jpeg=False)
    assert (with_dim_parts(measured, lit) >= lit).all()
