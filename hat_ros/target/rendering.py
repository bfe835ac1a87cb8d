"""Rendering the CAD model at a pose: one small protocol, two implementations.

Pixel centres lie at integer coordinates (OpenCV): pixel (u, v) sees exactly the ray ``K^-1 [u, v, 1]``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Protocol

from hat_ros.array_types import Bool, Float, Float32, Int32, UInt8
from hat_ros.errors import ConfigError
from hat_ros.target.model import Target
from hat_ros.types import Camera


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a camera sees of the target, pixel by pixel.

    Attributes:
        depth_m: (H, W) float32 distance along the optical axis, 0 = miss.
        normal_cam: (H, W, 3) float32 unit normal of the face in the camera frame, towards the camera; 0 = miss.
        face_id: (H, W) int32 index into ``Target.faces``, -1 = miss.
        rgb: (H, W, 3) uint8 sRGB albedo without any shading, 0 = miss.
    """

    depth_m: Float32
    normal_cam: Float32
    face_id: Int32
    rgb: UInt8

    @cached_property
    def mask(self) -> Bool:
        """(H, W) silhouette."""
        return self.face_id >= 0


class Renderer(Protocol):
    """A renderer of one target. Constructed as ``Backend(target: Target)``."""

    def render(self, T_cam_target: Float, camera: Camera, color: bool = True) -> Rendering:
        """Render the target.

        Args:
            T_cam_target: (4, 4) pose.
            camera: intrinsics and image size; use ``camera.crop`` to render a part only.
            color: False leaves ``rgb`` black, which saves the texture look-ups.
        """
        ...


RENDERERS = {
    "rays": "hat_ros.target.ray_renderer:RayRenderer",
    "pyrender": "hat_ros.target.pyrender:PyrenderRenderer",
}


def create_renderer(name: str, target: Target) -> Renderer:
    """Build a renderer: ``rays`` (no GL, deterministic) or ``pyrender`` (EGL, extra ``gl``).

    Raises:
        ConfigError: unknown name.
        MissingDependencyError: the renderer's package or an EGL driver is missing.
    """
    if name not in RENDERERS:
        raise ConfigError(f"renderer: unknown name '{name}', known are {', '.join(sorted(RENDERERS))}")
    module_name, class_name = RENDERERS[name].split(":")
    return getattr(import_module(module_name), class_name)(target)
