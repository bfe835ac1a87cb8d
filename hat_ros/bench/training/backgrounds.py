"""What a target may stand before, in linear light: planets at every phase and size, Earth, textures, rooms.

Black sky, stars and stray light are added when an image is composed (:mod:`hat_ros.bench.training.samples`).
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.special import ndtr

from hat_ros.array_types import Float, Float32, UInt8
from hat_ros.bench.synth.backdrop import Earth, EarthView
from hat_ros.bench.training.coding import encode
from hat_ros.types import Camera

# Pixels; samples of at most HEIGHT a side are cut out of it.
WIDTH, HEIGHT = 384, 288
# Kinds, and the shares of the backgrounds that they make up.
_KINDS = ("earth", "planet", "texture", "leaves")
_SHARES = (0.3, 0.35, 0.15, 0.2)
# Sets these draws apart from those of views with the same seed.
_STREAM = 71


def render_background(number: int, seed: int) -> UInt8:
    """Background of a number, (HEIGHT, WIDTH, 3) uint8, radiance as :mod:`hat_ros.bench.training.coding` codes it."""
    rng = np.random.default_rng([seed, _STREAM, number])
    kind = rng.choice(_KINDS, p=_SHARES)
    return encode(_MAKERS[kind](rng))


def fractal_noise(rng: np.random.Generator, slope: float, side: int = 512) -> Float32:
    """(side, side) periodic noise, even in [0, 1], whose spectrum falls with frequency to the power -slope."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.rfftfreq(side), indexing="ij"))
    frequency[0, 0] = np.inf
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((side, side))) * frequency**-slope, s=(side, side))
    return ndtr((noise - noise.mean()) / noise.std()).astype(np.float32)


def _earth(rng: np.random.Generator) -> Float32:
    """The Earth of ``hat synth``, seen from any height at any time of day through any lens."""
    nadir = np.array([rng.normal(0, 0.5), rng.normal(0, 0.5), 1.0])
    if rng.random() < 0.4:
        nadir[2] = rng.uniform(0.2, 0.6)  # towards the limb
    earth = Earth(np.exp(rng.uniform(*np.log((250, 3000)))), tuple(nadir.tolist()), 0.0, int(rng.integers(1 << 31)))
    focal = np.exp(rng.uniform(*np.log((250, 2000))))
    K = np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1.0]])
    to_sun = rng.normal(size=3) - 0.6 * nadir / np.linalg.norm(nadir)
    return EarthView(earth, Camera(K, WIDTH, HEIGHT), to_sun).radiance(0.0)


def _planet(rng: np.random.Generator) -> Float32:
    """A sphere of any size, anywhere in or beyond the image, at any phase: moons, limbs, ground seen from above."""
    radius = np.exp(rng.uniform(np.log(12), np.log(3000)))
    angle = rng.uniform(0, 2 * np.pi)
    away = radius * np.sqrt(rng.random()) if radius < 150 else radius + rng.uniform(-1.0, 0.5) * HEIGHT
    away = min(away, radius) if rng.random() < 0.5 else away
    cx, cy = WIDTH / 2 + away * np.cos(angle), HEIGHT / 2 + away * np.sin(angle)
    x, y = np.meshgrid((np.arange(WIDTH) - cx) / radius, (np.arange(HEIGHT) - cy) / radius)
    height = 1.0 - x * x - y * y
    z = np.sqrt(np.maximum(height, 0.0))
    to_sun = rng.normal(size=3) + np.array([0, 0, 0.6])
    to_sun /= np.linalg.norm(to_sun)
    lit = np.clip((x * to_sun[0] + y * to_sun[1] + z * to_sun[2]), 0, 1) ** rng.uniform(0.4, 1.0)
    disc = np.clip(0.5 + 0.5 * height * radius, 0, 1)
    albedo = _surface(rng, x, y)
    out = albedo * (lit * disc)[..., None]
    if rng.random() < 0.5:  # an atmosphere
        depth = np.exp(-np.maximum(-height, 0) * radius / (2 * rng.uniform(1, 12)))
        rim = np.where(height < 0, depth, 0.3 * (1 - z) ** 3) * np.clip(0.3 + x * to_sun[0] + y * to_sun[1], 0, 1)
        out += rim[..., None] * rng.uniform(0.2, 1.0, 3) * 0.5
    return (out * rng.uniform(0.3, 1.3)).astype(np.float32)


def _surface(rng: np.random.Generator, x: Float, y: Float) -> Float32:
    """Albedo (h, w, 3): two colours of ground and a layer of clouds, each with noise of its own kind."""
    side = 512
    size = np.exp(rng.uniform(np.log(60), np.log(900))) / max(np.ptp(x), 1e-6) * (WIDTH / side)
    turn = rng.uniform(0, 2 * np.pi)
    u = ((np.cos(turn) * x - np.sin(turn) * y) * size * rng.uniform(0.6, 1.6) + rng.random() * side) % side
    v = ((np.sin(turn) * x + np.cos(turn) * y) * size + rng.random() * side) % side
    maps = (u.astype(np.float32), v.astype(np.float32))

    def layer(slope: float) -> Float32:
        noise = fractal_noise(rng, slope, side)
        return np.asarray(cv2.remap(noise, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.float32)

    mix = np.clip((layer(rng.uniform(0.8, 2.2)) - 0.5) * np.exp(rng.uniform(0, 3)) + 0.5, 0, 1)[..., None]
    dark, bright = (rng.uniform(0.0, 1.0, 3) * np.exp(rng.uniform(*np.log((0.03, 0.7)))) for _ in range(2))
    out = dark * (1 - mix) + bright * mix
    if rng.random() < 0.6:
        edge = rng.uniform(1.5, 8.0)
        clouds = np.clip((layer(rng.uniform(0.9, 1.8)) - rng.uniform(0.2, 0.7)) * edge, 0, 1)[..., None]
        out = out * (1 - clouds) + rng.uniform(0.4, 0.9) * clouds
    return np.asarray(out, np.float32)


def _texture(rng: np.random.Generator) -> Float32:
    """A surface that fills the image, unevenly lit."""
    x, y = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(-0.75, 0.75, HEIGHT))
    slope = rng.normal(0, 0.4, 2)
    light = np.clip(1.0 + slope[0] * x + slope[1] * y, 0.1, None)[..., None]
    return (_surface(rng, x, y) * light * rng.uniform(0.3, 1.5)).astype(np.float32)


def _leaves(rng: np.random.Generator) -> Float32:
    """Overlapping shapes of all sizes, as rooms and cluttered tables have them."""
    out = np.full((HEIGHT, WIDTH, 3), rng.uniform(0, 0.6, 3), np.float32)
    light = rng.uniform(0.3, 1.0)
    for size in np.sort(np.exp(rng.uniform(np.log(4), np.log(300), int(rng.integers(8, 160)))))[::-1]:
        center = (rng.uniform(0, WIDTH), rng.uniform(0, HEIGHT))
        colour = rng.uniform(0, 1, 3) ** 2 if rng.random() < 0.6 else np.full(3, rng.random() ** 2)
        axes = (size, size * rng.uniform(0.1, 1.0))
        box = (center, axes, rng.uniform(0, 180))
        paint = tuple((light * colour).tolist())
        if rng.random() < 0.7:
            cv2.fillPoly(out, [np.rint(cv2.boxPoints(box)).astype(np.int32)], paint, cv2.LINE_AA)
        else:
            cv2.ellipse(out, box, paint, -1, cv2.LINE_AA)
    if rng.random() < 0.6:
        grain = fractal_noise(rng, rng.uniform(0.3, 1.5))[:HEIGHT, :WIDTH, None]
        out *= 1.0 + rng.uniform(0.1, 0.9) * (grain - 0.5)
    shade = fractal_noise(rng, 2.0)[:HEIGHT, :WIDTH, None]
    out *= 0.5 + shade
    return np.asarray(cv2.GaussianBlur(out, (0, 0), rng.uniform(0.4, 2.5)), np.float32)


_MAKERS = {"earth": _earth, "planet": _planet, "texture": _texture, "leaves": _leaves}
