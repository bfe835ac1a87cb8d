"""Renderings in the style that MegaPose's networks were trained on, ray cast instead of rasterised.

The published networks saw Panda3D images: 240 x 320, black background, pure albedo (one ambient light of intensity
one), four samples per pixel, K applied with pixel centres at +0.5, and the camera-frame normal stored as a colour
through Panda3D's eye-normal table. Depth is not an input of the RGB networks, so the reference's 10 m far plane, which
cuts distant targets off, is not imitated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hat_ros.render.embree import RayCaster, pixel_rays
from hat_ros.target import Target
from hat_ros.types import Camera

# Rotated-grid sample positions within a pixel, the usual 4x pattern of rasterisers.
_SAMPLES = np.array([[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]])
_TABLE_SIZE = 32


def encode_normals(normal_cam: NDArray[np.floating]) -> NDArray[np.float64]:
    """Colours 0..255 of camera-frame normals (x right, y down, z forward): (..., 3) -> (..., 3).

    Axes (x right, z forward, y up), each wrapped modulo one and read from a 32-step ramp with linear interpolation
    that wraps around, so that a component of exactly zero gives the value half-way between the ramp's ends.
    """
    n = np.asarray(normal_cam, dtype=np.float64)
    wrapped = np.stack([n[..., 0], n[..., 2], -n[..., 1]], axis=-1) % 1.0
    at = wrapped * _TABLE_SIZE - 0.5
    low = np.floor(at)
    ramp = 255.0 * np.arange(_TABLE_SIZE) / _TABLE_SIZE
    first, second = ramp[low.astype(int) % _TABLE_SIZE], ramp[(low.astype(int) + 1) % _TABLE_SIZE]
    return first + (at - low) * (second - first)


class NetworkViewRenderer:
    """RGB and coded normals of one target.

    Args:
        target: the CAD model.
    """

    def __init__(self, target: Target) -> None:
        self._target = target
        self._caster = RayCaster(target)

    def render(self, T_cam_target: NDArray[np.float64], K: NDArray[np.float64], size: tuple[int, int]) -> NDArray:
        """One view: (4, 4), (3, 3) with pixel centres at +0.5, (width, height) -> (H, W, 6) uint8 RGB + normals."""
        width, height = size
        T = np.asarray(T_cam_target, dtype=np.float64)
        u0, v0, u1, v1 = self._bounds(T, K, width, height)
        out = np.zeros((height, width, 6), np.uint8)
        if u0 >= u1 or v0 >= v1:
            return out
        camera = Camera(K, width, height)
        rays = np.stack(
            [pixel_rays(camera, np.arange(u0, u1) + du, np.arange(v0, v1) + dv) for du, dv in _SAMPLES], axis=2
        ).reshape(-1, 3)
        R, t = T[:3, :3], T[:3, 3]
        directions = rays @ R
        face, _, weights = self._caster.cast(np.broadcast_to(-t @ R, directions.shape), directions)
        hit = np.flatnonzero(face >= 0)
        values = np.zeros((len(face), 6))
        surface = self._target.surface
        values[hit, :3] = surface.sample(face[hit], weights[hit], self._target.face_rgb)
        normal = np.einsum("nk,nkc->nc", weights[hit], surface.corner_normal[face[hit]])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        values[hit, 3:] = encode_normals(normal @ R.T)
        pixels = values.reshape(v1 - v0, u1 - u0, len(_SAMPLES), 6).mean(axis=2)
        out[v0:v1, u0:u1] = np.rint(pixels).astype(np.uint8)
        return out

    def _bounds(self, T: NDArray[np.float64], K: NDArray[np.float64], width: int, height: int) -> tuple[int, ...]:
        """Half-open pixel range that can see the target's bounding sphere's box."""
        points = self._target.vertices_m @ T[:3, :3].T + T[:3, 3]
        if points[:, 2].max() <= 0:
            return 0, 0, 0, 0
        if points[:, 2].min() <= 1e-6:
            return 0, 0, width, height
        uv = points @ K.T
        uv = uv[:, :2] / uv[:, 2:]
        size = np.array([width, height])
        low = np.clip(np.floor(uv.min(axis=0)), 0, size).astype(int)
        high = np.clip(np.floor(uv.max(axis=0)) + 1, 0, size).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])
