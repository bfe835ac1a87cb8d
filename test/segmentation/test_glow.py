import numpy as np
import pytest
from segmentation_scene import HEIGHT, WIDTH, frame, overlap

from hat_ros.config import HatConfig
from hat_ros.segmentation.glow import fades_out, without_glow
from hat_ros.segmentation.sky import lit_regions, measure_sky
from hat_ros.segmentation.stage import SegmentationStage

X, Y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))


def around(x, y, reach_px):
    return np.exp(-np.hypot(X - x, Y - y) / reach_px)


GLOWS = {
    "sun beside the target": 160 * around(0.85 * WIDTH, 0.15 * HEIGHT, 35),
    "sun in the corner": 220 * around(0, 0, 50),
    "veil": 90 * np.exp(-((np.hypot(X - WIDTH, Y) / 90) ** 2)),
    "lit limb below": 80 * np.exp(-(HEIGHT - Y) / 50.0),
}
glows = pytest.mark.parametrize("glow", GLOWS.values(), ids=GLOWS.keys())


def lit_by(glow, image):
    return np.clip(image + glow[..., None], 0, 255).astype(np.uint8)


@glows
@pytest.mark.parametrize("angle", [0.3, 2.0])
def test_a_target_is_found_in_stray_light(lopsided, scene, glow, angle):
    T = scene.pose(angle)
    stage = SegmentationStage(HatConfig(), lopsided)
    found = stage.update(frame(0, lit_by(glow, scene.image(T))), None)
    assert overlap(found.mask, scene.truth(T)) > 0.93


@glows
def test_stray_light_alone_is_no_target(lopsided, glow):
    noise = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 1)) * 1.5 + 2.0
    image = lit_by(glow, np.broadcast_to(noise, (HEIGHT, WIDTH, 3)))
    assert SegmentationStage(HatConfig(), lopsided).update(frame(0, image), None) is None


def test_a_glow_fades_out_and_a_body_does_not(scene):
    T = scene.pose(0.3)
    for gain in (0.1, 1.0, 4.0):
        measured = measure_sky(scene.image(T, gain=gain))
        assert not fades_out(measured, lit_regions(measured)[0])
    measured = measure_sky(lit_by(100 * around(0.5 * WIDTH, 0.5 * HEIGHT, 20), np.zeros((HEIGHT, WIDTH, 3))))
    assert fades_out(measured, lit_regions(measured)[0])


@glows
def test_what_is_taken_off_is_the_glow(scene, glow):
    T = scene.pose(0.3)
    dark = scene.image(T, noise=0.0).astype(np.float64)
    cleared = without_glow(lit_by(glow, dark)).astype(np.float64)
    sky = ~scene.truth(T)
    assert np.percentile(np.abs(cleared - np.median(cleared[sky]))[sky], 95) < 4.0


def test_size_and_type_stay_as_they_were():
    for shape in ((3, 5, 3), (33, 700, 3), (240, 320, 3)):
        cleared = without_glow(np.full(shape, 30, np.uint8))
        assert cleared.shape == shape and cleared.dtype == np.uint8
        assert np.ptp(cleared) == 0
