"""What is behind the target: stars, and an Earth that turns under the camera, in linear light."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtr

from hat_ros.array_types import Bool, Float, Float32
from hat_ros.target.rays import pixel_rays
from hat_ros.types import Camera

_EARTH_RADIUS_KM = 6371.0
_ATMOSPHERE_KM = 60.0
_MAP_SIDE = 1024
# Degrees of ground that the repeating map covers: about 900 km, so that clouds look like clouds from low orbit.
_MAP_SPAN_RAD = np.radians(8.0)


@dataclass(frozen=True)
class Earth:
    """Where the Earth stands in the camera's view.

    Attributes:
        altitude_km: of the camera.
        nadir_cam: (3,) direction to the Earth's centre in the camera frame, any length.
        speed_deg_s: how fast the ground turns below; 0.065 is a low orbit.
        seed: of clouds and continents.
    """

    altitude_km: float = 500.0
    nadir_cam: tuple[float, float, float] = (0.0, 0.6, 1.0)
    speed_deg_s: float = 0.065
    seed: int = 0


class EarthView:
    """Renders the Earth for one camera and light."""

    def __init__(self, earth: Earth, camera: Camera, to_sun_cam: Float) -> None:
        self._earth = earth
        self._ground = _ground_map(np.random.default_rng([earth.seed, 1]))
        rays = pixel_rays(camera, np.arange(camera.width), np.arange(camera.height))
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        down = np.asarray(earth.nadir_cam, dtype=np.float64)
        down /= np.linalg.norm(down)
        center = down * (_EARTH_RADIUS_KM + earth.altitude_km)
        along = rays @ center
        miss_sq = center @ center - along * along  # squared distance of the ray from the Earth's centre
        depth = along - np.sqrt(np.maximum(_EARTH_RADIUS_KM**2 - miss_sq, 0.0))
        hit = (miss_sq < _EARTH_RADIUS_KM**2) & (along > 0)
        normal = (rays * depth[..., None] - center) / _EARTH_RADIUS_KM
        # Ground coordinates: angles along and across the flight direction, counted from the sub-camera point.
        forward = np.cross(down, [0.0, 0.0, 1.0] if abs(down[2]) < 0.9 else [1.0, 0.0, 0.0])
        forward /= np.linalg.norm(forward)
        side = np.cross(down, forward)
        up = -(normal @ down)
        pixels_per_rad = _MAP_SIDE / _MAP_SPAN_RAD
        self._x = (np.arctan2(normal @ forward, up) * pixels_per_rad).astype(np.float32)
        self._y = (np.arcsin(np.clip(normal @ side, -1, 1)) * pixels_per_rad).astype(np.float32)
        to_sun = to_sun_cam / np.linalg.norm(to_sun_cam)
        self._lit = (hit * np.clip(normal @ to_sun + 0.02, 0, 1)).astype(np.float32)[..., None]
        self._hit = hit
        self._haze = _haze(rays, center, along, miss_sq, hit, normal, to_sun)

    @property
    def covers(self) -> Bool:
        """(H, W) pixels in front of which the Earth stands."""
        return self._hit

    def radiance(self, time_s: float) -> Float32:
        """(H, W, 3) linear light at a time after the start."""
        shift = np.radians(self._earth.speed_deg_s) * time_s * _MAP_SIDE / _MAP_SPAN_RAD
        x = np.mod(self._x + np.float32(shift), _MAP_SIDE)
        y = np.mod(self._y, _MAP_SIDE)
        ground = cv2.remap(self._ground, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return ground * self._lit + self._haze


class Table:
    """A speckled table top below the target, for a camera that moves around a static scene.

    Args:
        height_m: of the plane z = const in the target frame.
        tile_m: ground covered by one repeat of the pattern.
        seed: of the pattern.
    """

    def __init__(self, height_m: float, tile_m: float, seed: int) -> None:
        rng = np.random.default_rng([seed, 3])
        broad, fine = _fractal_noise(rng, 1.6), _fractal_noise(rng, 0.8)
        self._map = ((0.15 + 0.5 * broad * fine)[..., None] * np.array([1.0, 0.85, 0.7])).astype(np.float32)
        self._height_m = height_m
        self._texels_per_m = _MAP_SIDE / tile_m

    def radiance(self, T_cam_target: Float, camera: Camera) -> Float32:
        """(H, W, 3) linear light, black above the horizon."""
        rays = pixel_rays(camera, np.arange(camera.width), np.arange(camera.height)) @ T_cam_target[:3, :3]
        eye = -T_cam_target[:3, 3] @ T_cam_target[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (self._height_m - eye[2]) / rays[..., 2]
        hit = np.isfinite(depth) & (depth > 0)
        ground = np.where(hit, depth, 0)[..., None] * rays[..., :2] + eye[:2]
        texel = np.mod(ground * self._texels_per_m, _MAP_SIDE).astype(np.float32)
        top = cv2.remap(self._map, texel[..., 0], texel[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return top * hit[..., None]


def stars(camera: Camera, seed: int, count: int) -> Float32:
    """(H, W, 3) field of point stars, most of them faint."""
    rng = np.random.default_rng([seed, 2])
    sky = np.zeros((camera.height, camera.width, 3), np.float32)
    rows, cols = rng.integers(camera.height, size=count), rng.integers(camera.width, size=count)
    sky[rows, cols] = (0.02 * rng.pareto(1.5, size=count).clip(0, 40))[:, None]
    return sky


def _haze(
    rays: Float,
    center: Float,
    along: Float,
    miss_sq: Float,
    hit: Bool,
    normal: Float,
    to_sun: Float,
) -> Float32:
    """Blue scattering: a thin bright limb that fades over the atmosphere's height, and a veil over the disc's edge."""
    height = np.sqrt(np.maximum(miss_sq, 0)) - _EARTH_RADIUS_KM
    limb = np.where(hit, 0.0, np.exp(-np.maximum(height, 0) / (_ATMOSPHERE_KM / 4))) * (along > 0)
    grazing = 1 - np.clip(-np.einsum("hwk,hwk->hw", rays, normal), 0, 1)
    veil = np.where(hit, 0.35 * grazing**4, 0.0)
    tangent = rays * along[..., None] - center
    tangent /= np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), 1e-9)
    day = np.clip(np.where(hit[..., None], normal, tangent) @ to_sun + 0.15, 0, 1)
    return ((0.5 * limb + veil) * day)[..., None].astype(np.float32) * np.array([0.35, 0.6, 1.0], np.float32)


def _ground_map(rng: np.random.Generator) -> Float32:
    """(N, N, 3) repeating albedo: sea, land, clouds."""
    land, clouds, detail = (_fractal_noise(rng, slope) for slope in (2.2, 1.7, 1.2))
    green = np.clip((land - 0.52) * 20, 0, 1)[..., None]
    ground = (1 - green) * np.array([0.015, 0.045, 0.13]) + green * np.array([0.11, 0.12, 0.05])
    ground = ground * (0.8 + 0.4 * detail[..., None])
    cover = (np.clip((clouds - 0.42) * 2.2, 0, 1) ** 1.5)[..., None]
    return (ground * (1 - cover) + 0.75 * cover).astype(np.float32)


def _fractal_noise(rng: np.random.Generator, slope: float) -> Float:
    """Periodic noise in [0, 1] whose spectrum falls with frequency to the power -slope."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(_MAP_SIDE), np.fft.rfftfreq(_MAP_SIDE), indexing="ij"))
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((_MAP_SIDE, _MAP_SIDE))) * frequency ** (-slope / 1.3)
    noise = np.fft.irfft2(spectrum, s=(_MAP_SIDE, _MAP_SIDE))
    return ndtr((noise - noise.mean()) / noise.std())  # Gaussian to uniform
