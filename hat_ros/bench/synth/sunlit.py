"""A spacecraft in sunlight, in linear light: what the synthetic clips are made of.

One hard sun with cast shadows, a little even light, Lambert plus GGX gloss (Walter et al., "Microfacet Models for
Refraction through Rough Surfaces", EGSR 2007, eqs. 20, 33, 34; Fresnel after Schlick 1994). Anti-aliased by a regular
grid of rays per pixel and by texture levels matched to the pixel's footprint.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import csr_matrix

from hat_ros.array_types import Float, Float32, Int32
from hat_ros.target.model import Surface, Target, area_vectors
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.rays import pixel_rays
from hat_ros.target.srgb import linear_from_srgb
from hat_ros.types import Camera

# Face normals closer than this are smoothed over, so that turned parts look round and box edges stay sharp.
_CREASE_DEG = 35.0
_LINEAR = linear_from_srgb(np.arange(256, dtype=np.uint8)).astype(np.float32)


@dataclass(frozen=True)
class Light:
    """Illumination in the camera frame, radiometric units in which a white Lambertian face square to the sun is 1.

    Attributes:
        to_sun_cam: (3,) direction to the sun, any length.
        ambient: even light from all sides.
        to_earth_cam: (3,) direction to the Earth's centre, or None.
        earthshine: light from that side, falling off with the cosine to the far side.
    """

    to_sun_cam: Float
    ambient: float = 0.004
    to_earth_cam: Float | None = None
    earthshine: float = 0.0


class SunlitRenderer:
    """Shaded images of one target.

    Args:
        target: the model.
        supersample: rays per pixel and side.
        gloss: multiplies the specular part; 1 is physical.
    """

    def __init__(self, target: Target, supersample: int = 2, gloss: float = 1.0) -> None:
        self._target = target
        self._n = supersample
        self._gloss = np.float32(gloss)
        self.plain = RayRenderer(target)
        self._normals = smoothed_normals(target)
        self._albedo = _MipSampler(target)

    def render(self, T_cam_target: Float, camera: Camera, light: Light) -> tuple[Float32, Float32]:
        """Radiance (H, W, 3), premultiplied by coverage, and coverage (H, W) of the target, 0..1."""
        radiance = np.zeros((camera.height, camera.width, 3), np.float32)
        coverage = np.zeros((camera.height, camera.width), np.float32)
        x0, y0, x1, y1 = self.plain.pixel_bounds(T_cam_target, camera)
        if x0 >= x1 or y0 >= y1:
            return radiance, coverage
        n = self._n
        offsets = (np.arange(n) + 0.5) / n - 0.5
        u = (np.arange(x0, x1)[:, None] + offsets).ravel()
        v = (np.arange(y0, y1)[:, None] + offsets).ravel()
        rays = pixel_rays(camera, u, v).reshape(-1, 3)
        R, t = T_cam_target[:3, :3], T_cam_target[:3, 3]
        directions, origin = (rays @ R).astype(np.float32), (-t @ R).astype(np.float32)
        hits = self.plain.caster.trace(np.broadcast_to(origin, directions.shape), directions)
        hit = np.flatnonzero(hits.face >= 0)
        colors = np.zeros((len(rays), 4), np.float32)
        if hit.size:
            seen = hits.taken(hit)
            footprint = seen.distance / np.float32(camera.K[0, 0] * n)
            points = origin + directions[hit] * seen.distance[:, None]
            colors[hit, :3] = self._shade(
                seen.face, seen.barycentric, points, directions[hit], footprint,
                _unit(light.to_sun_cam @ R), light, R,
            )  # fmt: skip
            colors[hit, 3] = 1.0
        block = colors.reshape(y1 - y0, n, x1 - x0, n, 4).mean(axis=(1, 3))
        radiance[y0:y1, x0:x1], coverage[y0:y1, x0:x1] = block[..., :3], block[..., 3]
        return radiance, coverage

    def _shade(
        self,
        face: Int32,
        barycentric: Float32,
        points: Float32,
        directions: Float32,
        footprint_m: Float32,
        to_sun: Float32,
        light: Light,
        R_cam_target: Float,
    ) -> Float32:
        """Radiance (N, 3) at hits, everything in the target frame."""
        to_eye = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
        geometric = self._target.face_normals[face].astype(np.float32)
        geometric *= np.where(np.einsum("nk,nk->n", geometric, to_eye) < 0, np.float32(-1), np.float32(1))[:, None]
        normal = np.einsum("nk,nkc->nc", barycentric, self._normals[face])
        normal *= np.where(np.einsum("nk,nk->n", normal, geometric) < 0, np.float32(-1), np.float32(1))[:, None]
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.float32(1e-6))

        albedo = self._albedo.sample(face, barycentric, footprint_m)
        metallic = self._target.surface.metallic[face][:, None]
        diffuse = albedo * (1 - metallic)
        out = diffuse * np.float32(light.ambient)
        if light.to_earth_cam is not None and light.earthshine > 0:
            to_earth = _unit(np.asarray(light.to_earth_cam) @ R_cam_target)
            out += (albedo * np.float32(light.earthshine)) * (0.5 + 0.5 * normal @ to_earth)[:, None]

        lit = np.flatnonzero((geometric @ to_sun > 0) & (normal @ to_sun > 0))
        start = points[lit] + geometric[lit] * np.float32(1e-4 * self._target.bounding_radius_m)
        lit = lit[~self.plain.caster.occluded(start, np.broadcast_to(to_sun, start.shape))]
        cos_sun = (normal[lit] @ to_sun)[:, None]
        specular = _ggx(
            normal[lit], to_eye[lit], to_sun, self._target.surface.roughness[face[lit]], albedo[lit], metallic[lit]
        )
        # A Lambertian face of albedo 1 square to the sun gives 1, so irradiance is pi and f_d = albedo / pi.
        out[lit] += (diffuse[lit] + self._gloss * np.float32(np.pi) * specular) * cos_sun
        return out


def _ggx(
    normal: Float32, to_eye: Float32, to_sun: Float32, roughness: Float32, albedo: Float32, metallic: Float32
) -> Float32:
    """Specular BRDF (N, 3)."""
    half = to_eye + to_sun
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), np.float32(1e-6))
    n_h = np.clip(np.einsum("nk,nk->n", normal, half), 0, 1)
    n_v = np.clip(np.einsum("nk,nk->n", normal, to_eye), 0.05, 1)
    n_l = np.clip(normal @ to_sun, 0.05, 1)
    v_h = np.clip(np.einsum("nk,nk->n", to_eye, half), 0, 1)
    a2 = np.maximum(roughness, np.float32(0.15)) ** 4
    d = a2 / (np.float32(np.pi) * ((n_h * n_h) * (a2 - 1) + 1) ** 2)
    visibility = 0.5 / (n_l * np.sqrt(n_v * n_v * (1 - a2) + a2) + n_v * np.sqrt(n_l * n_l * (1 - a2) + a2))
    f0 = np.float32(0.04) * (1 - metallic) + albedo * metallic
    fresnel = f0 + (1 - f0) * ((1 - v_h) ** 5)[:, None]
    return fresnel * (d * visibility)[:, None]


def smoothed_normals(target: Target) -> Float32:
    """(F, 3, 3) unit normals at the corners of each face, smoothed over neighbours within the crease angle."""
    weighted, unit = area_vectors(target.corners_m), target.face_normals
    n_faces, n_vertices = len(target.faces), len(target.vertices_m)
    incidence = csr_matrix(
        (np.ones(3 * n_faces), (np.repeat(np.arange(n_faces), 3), target.faces.ravel())), (n_faces, n_vertices)
    ).tocsc()
    valence = np.diff(incidence.indptr)
    out = np.repeat(unit[:, None], 3, axis=1)
    smooth = valence[target.faces] <= 64  # a fan of hundreds of faces is a flat cap
    flat_face, flat_corner = np.nonzero(smooth)
    vertex = target.faces[flat_face, flat_corner]
    counts = valence[vertex]
    owner = np.repeat(np.arange(len(vertex)), counts)
    start = np.repeat(incidence.indptr[vertex] - np.concatenate([[0], np.cumsum(counts)[:-1]]), counts)
    neighbour = incidence.indices[start + np.arange(len(owner))]
    near = np.einsum("nk,nk->n", unit[neighbour], unit[flat_face[owner]]) > np.cos(np.radians(_CREASE_DEG))
    total = np.zeros((len(vertex), 3))
    for axis in range(3):
        total[:, axis] = np.bincount(owner[near], weighted[neighbour[near], axis], minlength=len(vertex))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    out[flat_face, flat_corner] = np.where(length > 0, total / np.maximum(length, 1e-300), unit[flat_face])
    return out.astype(np.float32)


class _MipSampler:
    """Linear albedo with the texture level that fits the footprint of a ray."""

    def __init__(self, target: Target) -> None:
        self._surface: Surface = target.surface
        self._face_rgb = _LINEAR[target.face_rgb]
        self._levels: list[list[Float32]] = []
        for texture in target.surface.textures:
            level = _LINEAR[texture]
            levels = [level]
            while min(level.shape[:2]) > 1:
                half = cv2.resize(level, (level.shape[1] // 2, level.shape[0] // 2), interpolation=cv2.INTER_AREA)
                level = np.asarray(half, np.float32)
                levels.append(level)
            self._levels.append(levels)
        a, b = (self._surface.corner_uv[:, i] - self._surface.corner_uv[:, 0] for i in (1, 2))
        texels = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        sizes = np.array([texture.shape[0] * texture.shape[1] for texture in target.surface.textures] + [0])
        self._texels_per_m = np.sqrt(texels * sizes[self._surface.texture_id] / target.face_areas_m2).astype(np.float32)

    def sample(self, face: Int32, barycentric: Float32, footprint_m: Float32) -> Float32:
        """(N,), (N, 3), (N,) -> (N, 3) linear albedo."""
        out = self._face_rgb[face]
        if self._surface.corner_rgb is not None:
            out = np.einsum("nk,nkc->nc", barycentric, _LINEAR[self._surface.corner_rgb[face]])
        texture_id = self._surface.texture_id[face]
        level = np.log2(np.maximum(self._texels_per_m[face] * footprint_m, 1.0)).astype(np.int32)
        for index, levels in enumerate(self._levels):
            mine = np.flatnonzero(texture_id == index)
            if not mine.size:
                continue
            uv = np.einsum("nk,nkc->nc", barycentric[mine], self._surface.corner_uv[face[mine]])
            depth = np.minimum(level[mine], len(levels) - 1)
            for number in np.unique(depth):
                pick = depth == number
                out[mine[pick]] = _bilinear(levels[number], uv[pick])
        return out


def _bilinear(texture: Float32, uv: Float32) -> Float32:
    """Wrapped bilinear look-up: (h, w, 3), (N, 2) -> (N, 3)."""
    height, width = texture.shape[:2]
    x = (uv[:, 0] % 1.0) * width - 0.5
    y = ((1.0 - uv[:, 1]) % 1.0) * height - 0.5
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - x0).astype(np.float32)[:, None], (y - y0).astype(np.float32)[:, None]
    xa, xb, ya, yb = x0 % width, (x0 + 1) % width, y0 % height, (y0 + 1) % height
    top = texture[ya, xa] * (1 - fx) + texture[ya, xb] * fx
    return top * (1 - fy) + (texture[yb, xa] * (1 - fx) + texture[yb, xb] * fx) * fy


def _unit(vector: Float) -> Float32:
    return (vector / np.linalg.norm(vector)).astype(np.float32)
