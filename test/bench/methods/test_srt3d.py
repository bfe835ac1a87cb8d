"""The region tracker: colours, correspondence, and a planted motion."""

import numpy as np
import pytest

from hat_ros.bench.methods import srt3d
from hat_ros.bench.methods.srt3d import ColorHistograms, RegionTracker
from hat_ros.bench.synth.models import build_target
from hat_ros.geometry import lie
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.types import Camera, Frame

CAMERA = Camera(np.array([[400.0, 0, 119.5], [0, 400.0, 89.5], [0, 0, 1]]), 240, 180)


@pytest.fixture(scope="module")
def target():
    return build_target("probe")


@pytest.fixture(scope="module")
def renderer(target):
    return RayRenderer(target)


def pose(i, target, distance=2.6):
    R = lie.so3_exp(np.radians([1.5 * i, -0.8 * i, 0.5 * i])) @ lie.so3_exp(np.array([0.7, 0.4, -0.3]))
    scale = distance * target.bounding_radius_m
    return lie.transform(R, np.array([0.02 * i, -0.01 * i, scale + 0.02 * i * target.bounding_radius_m]))


def picture(i, T, renderer):
    seen = renderer.render(T, CAMERA)
    rng = np.random.default_rng(i)
    shade = np.clip(0.35 + 0.65 * np.abs(seen.normal_cam[..., 2:]), 0, 1)
    rgb = np.where(seen.mask[..., None], np.maximum(seen.rgb, 70) * shade, np.array([20.0, 30, 60]))
    noisy = np.clip(rgb + rng.normal(0, 4, rgb.shape), 0, 255).astype(np.uint8)
    return Frame(1_000_000_000 + i, noisy, CAMERA)


def test_follows_a_planted_motion(target, renderer):
    tracker = RegionTracker(target)
    T = pose(0, target)
    tracker.start(picture(0, T, renderer), T)
    for i in range(1, 15):
        T = tracker.track(picture(i, pose(i, target), renderer), T)
    true = pose(14, target)
    assert np.degrees(lie.angle_between(T[:3, :3], true[:3, :3])) < 4.0
    assert np.linalg.norm(T[:3, 3] - true[:3, 3]) < 0.04 * true[2, 3]


def test_result_does_not_depend_on_the_unit_of_length(target, renderer):
    from dataclasses import replace

    big = replace(target, vertices_m=target.vertices_m * 20.0)
    ends = []
    for body, factor in ((target, 1.0), (big, 20.0)):
        tracker = RegionTracker(body)
        T = pose(0, target)
        T[:3, 3] *= factor
        tracker.start(picture(0, pose(0, target), renderer), T)
        T = tracker.track(picture(1, pose(1, target), renderer), T)
        T[:3, 3] /= factor
        ends.append(T)
    np.testing.assert_allclose(ends[0], ends[1], atol=0.02)


def test_target_behind_the_camera_ends_the_track(target, renderer):
    tracker = RegionTracker(target)
    T = pose(0, target)
    tracker.start(picture(0, T, renderer), T)
    T[2, 3] = -1.0
    assert tracker.track(picture(0, pose(0, target), renderer), T) is None


def test_histograms_are_undecided_about_unseen_colours_and_learn_at_the_set_rate():
    colors = ColorHistograms()
    red, blue, green = (np.array([c] * 10, np.uint8) for c in ([200, 0, 0], [0, 0, 200], [0, 200, 0]))
    colors.learn(red, blue)
    foreground, background = colors.probabilities(np.vstack([red[:1], blue[:1], green[:1]]))
    np.testing.assert_allclose(foreground, [1.0, 0.0, 0.5])
    np.testing.assert_allclose(foreground + background, 1.0)
    colors.learn(blue, red)
    foreground, _ = colors.probabilities(red[:1])
    np.testing.assert_allclose(foreground, [1.0 - srt3d.HISTOGRAM_RATE])


def test_posterior_finds_a_sharp_edge_and_is_flat_without_one():
    p_f = np.zeros((2, 19))
    p_f[0, :12] = 1.0  # inside up to segment 11: the edge lies 2.5 segments outwards of the line's centre
    p_f[1] = 0.5
    posterior = srt3d._posterior(p_f, 1.0 - p_f)
    offset = np.arange(12) - 5.5
    assert posterior[0] @ offset == pytest.approx(2.5, abs=0.1)
    np.testing.assert_allclose(posterior[1], 1 / 12)
