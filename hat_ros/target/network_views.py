"""Renderings in the style that MegaPose's networks were trained on.

The published networks saw Panda3D images: 240 x 320, black background, pure albedo (one ambient light of intensity
one), four samples per pixel, K applied with pixel centres at +0.5, and the camera-frame normal stored as a colour
through Panda3D's eye-normal table. Depth is not an input of the RGB networks, so the reference's 10 m far plane, which
cuts distant targets off, is not imitated.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hat_ros.array_types import Float, Float32, Int, Int32, UInt8
from hat_ros.spans import span
from hat_ros.target.model import Target
from hat_ros.target.raster import edge_functions, nearest_faces

Scalar = TypeVar("Scalar", bound=np.generic)

# Rotated-grid sample positions within a pixel, the usual 4x pattern of rasterisers.
_SAMPLES = np.array([[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]])
_TABLE_SIZE = 32
_NO_COLORS = np.zeros((0, 3, 3), np.uint8)


class NetworkViewRenderer:
    """RGB and coded normals of one target.

    Args:
        target: the CAD model.
        n_threads: views rendered at a time; each is the same whatever the number.
    """

    def __init__(self, target: Target, n_threads: int = 1) -> None:
        self._corners_m = np.ascontiguousarray(target.vertices_m[target.faces])
        self._look = _look_of(target)
        self._pool = ThreadPoolExecutor(n_threads, "render")

    def render(self, T_cam_target: Float, K: Float, size: tuple[int, int]) -> NDArray:
        """One view: (4, 4), (3, 3) with pixel centres at +0.5, (width, height) -> (H, W, 6) uint8 RGB + normals."""
        with span("renders"):
            return self._view(T_cam_target, K, size)

    def render_many(self, T_cam_target: Float, K: Float, size: tuple[int, int]) -> UInt8:
        """Views of (N, 4, 4) poses by (N, 3, 3) cameras of one size: (N, H, W, 6), see :meth:`render`."""
        with span("renders", len(K)):
            views = list(self._pool.map(self._view, T_cam_target, K, [size] * len(K)))
        return np.stack(views) if views else np.zeros((0, size[1], size[0], 6), np.uint8)

    def _view(self, T_cam_target: Float, K: Float, size: tuple[int, int]) -> NDArray:
        width, height = size
        T, K = np.asarray(T_cam_target, dtype=np.float64), np.ascontiguousarray(K, dtype=np.float64)
        R = np.ascontiguousarray(T[:3, :3])
        corners = self._corners_m @ R.T + T[:3, 3]
        edges = edge_functions(corners, np.asarray(np.linalg.inv(K), np.float64))
        face = nearest_faces(corners, K, edges, _SAMPLES, width, height)
        return _shade(face, edges, _SAMPLES, R, self._look)


class _Look(NamedTuple):
    """What shading needs of a surface, as arrays that compiled code can read.

    Attributes:
        face_rgb: (F, 3) uint8. corner_rgb: (F, 3, 3) uint8, or (0, 3, 3) when there are none.
        corner_normal: (F, 3, 3). corner_uv: (F, 3, 2). texture_id: (F,), -1 = none.
        texels: (T, 3) uint8 of all textures, row by row. texture_shape: (n, 3) first texel, height, width.
    """

    face_rgb: UInt8
    corner_rgb: UInt8
    corner_normal: Float32
    corner_uv: Float32
    texture_id: NDArray[np.int16]
    texels: UInt8
    texture_shape: Int


def _look_of(target: Target) -> _Look:
    surface = target.surface
    textures = surface.textures
    first = np.cumsum([0] + [texture.shape[0] * texture.shape[1] for texture in textures])
    shapes = [(start, *texture.shape[:2]) for start, texture in zip(first, textures, strict=False)]
    texels = [texture.reshape(-1, 3) for texture in textures]
    return _Look(
        _owned(target.face_rgb),
        _owned(_NO_COLORS if surface.corner_rgb is None else surface.corner_rgb),
        _owned(surface.corner_normal),
        _owned(surface.corner_uv),
        _owned(surface.texture_id),
        np.concatenate(texels) if texels else np.zeros((0, 3), np.uint8),
        np.array(shapes, dtype=np.int64).reshape(-1, 3),
    )


def _owned(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """A writable copy, row by row: one type for compiled code, wherever the array came from."""
    return np.array(array, order="C")


@njit(cache=True, nogil=True)
def encode_normal(component: float) -> float:
    """Colour 0..255 of one component of a unit normal: (x right), (z forward) or (y up) of the camera.

    Wrapped modulo one and read from a 32-step ramp with linear interpolation that wraps around, so that a component of
    exactly zero gives the value half-way between the ramp's ends.
    """
    at = (component - np.floor(component)) * _TABLE_SIZE - 0.5
    low = np.floor(at)
    first = 255.0 * (int(low) % _TABLE_SIZE) / _TABLE_SIZE
    second = 255.0 * ((int(low) + 1) % _TABLE_SIZE) / _TABLE_SIZE
    return first + (at - low) * (second - first)


@njit(cache=True, nogil=True)
def _shade(
    face: Int32,
    edges: Float,
    samples: Float,
    R_cam_target: Float,
    look: _Look,
) -> UInt8:
    """Mean colour and coded normal of each pixel's samples, black where they miss: (H, W, 6) uint8."""
    height, width, n_samples = face.shape
    out = np.zeros((height, width, 6), np.uint8)
    total, value, weights = np.zeros(6), np.zeros(6), np.zeros(3)
    for y in range(height):
        for x in range(width):
            seen = False
            for s in range(n_samples):
                f = face[y, x, s]
                if f < 0:
                    continue
                if not seen:
                    seen, total[:] = True, 0.0
                for i in range(3):
                    weights[i] = edges[f, i, 0] * (x + samples[s, 0]) + edges[f, i, 1] * (y + samples[s, 1])
                    weights[i] += edges[f, i, 2]
                scale = 1.0 / (weights[0] + weights[1] + weights[2])
                for i in range(3):
                    weights[i] *= scale
                _albedo(f, weights, look, value)
                _coded_normal(f, weights, R_cam_target, look.corner_normal, value)
                for c in range(6):
                    total[c] += value[c]
            if seen:
                for c in range(6):
                    out[y, x, c] = np.uint8(np.rint(total[c] / n_samples))
    return out


@njit(cache=True, nogil=True)
def _albedo(f: int, weights: Float, look: _Look, value: Float) -> None:
    """Colour of a point on a face into ``value[:3]``, as ``Surface.sample`` gives it."""
    texture = look.texture_id[f]
    if texture >= 0:
        first, height, width = look.texture_shape[texture]
        uv = look.corner_uv[f]
        u = weights[0] * uv[0, 0] + weights[1] * uv[1, 0] + weights[2] * uv[2, 0]
        v = weights[0] * uv[0, 1] + weights[1] * uv[1, 1] + weights[2] * uv[2, 1]
        u, v = u - np.floor(u), np.ceil(v) - v  # v is up
        column, row = int(u * width) % width, int(v * height) % height
        for c in range(3):
            value[c] = look.texels[first + row * width + column, c]
    elif len(look.corner_rgb):
        rgb = look.corner_rgb[f]
        for c in range(3):
            value[c] = weights[0] * rgb[0, c] + weights[1] * rgb[1, c] + weights[2] * rgb[2, c]
    else:
        for c in range(3):
            value[c] = look.face_rgb[f, c]


@njit(cache=True, nogil=True)
def _coded_normal(
    f: int,
    weights: Float,
    R_cam_target: Float,
    corner_normal: Float32,
    value: Float,
) -> None:
    """Coded shading normal of a point on a face into ``value[3:]``: x right, z forward, y up."""
    n = corner_normal[f]
    x = weights[0] * n[0, 0] + weights[1] * n[1, 0] + weights[2] * n[2, 0]
    y = weights[0] * n[0, 1] + weights[1] * n[1, 1] + weights[2] * n[2, 1]
    z = weights[0] * n[0, 2] + weights[1] * n[1, 2] + weights[2] * n[2, 2]
    scale = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-12)
    R = R_cam_target
    value[3] = encode_normal(scale * (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z))
    value[4] = encode_normal(scale * (R[2, 0] * x + R[2, 1] * y + R[2, 2] * z))
    value[5] = encode_normal(-scale * (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z))
