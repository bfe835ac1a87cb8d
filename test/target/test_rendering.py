"""Renderers by name, and the one with OpenGL against the one that casts rays."""

import numpy as np
import pytest

from hat_ros.bench.synth.models import build_target
from hat_ros.errors import ConfigError, MissingDependencyError
from hat_ros.geometry import lie
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.rendering import create_renderer
from hat_ros.types import Camera

CAMERA = Camera(np.array([[200.0, 0.0, 63.0], [0.0, 210.0, 47.5], [0.0, 0.0, 1.0]]), 128, 96)


def test_the_default_renderer_casts_rays():
    assert isinstance(create_renderer("rays", build_target("cubesat")), RayRenderer)


def test_unknown_renderer():
    with pytest.raises(ConfigError, match="rays"):
        create_renderer("vulkan", build_target("cubesat"))


def test_pyrender_agrees_or_says_what_is_missing():
    target, T = build_target("observer"), lie.transform(lie.so3_exp(np.array([1.0, 0.3, 0.1])), np.array([0, 0, 6.0]))
    try:
        renderer = create_renderer("pyrender", target)
        view = renderer.render(T, CAMERA)
    except MissingDependencyError as error:
        assert "rays" in str(error)
        return
    traced = RayRenderer(target).render(T, CAMERA)
    both = view.mask & traced.mask
    assert both.sum() > 0.95 * traced.mask.sum()
    assert np.median(np.abs(view.depth_m - traced.depth_m)[both]) < 0.01
    assert np.abs(view.rgb[both].astype(float) - traced.rgb[both]).mean() < 20
    renderer.close()
