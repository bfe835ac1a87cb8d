"""Training images, composed from views and backgrounds as a camera would see them; each sample hangs on its number."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hat_ros.array_types import Float, Float32, UInt8
from hat_ros.bench.training.coding import decode
from hat_ros.bench.training.views import Views
from hat_ros.segmentation.network import PRIOR_STRIDE
from hat_ros.target.srgb import srgb_from_linear

# Shares of samples: an image without a target; a whole image, in which the target is small; the others are crops.
_SHARE_EMPTY, _SHARE_WHOLE = 0.04, 0.36
# Of crops: with a prior silhouette; of those: nearly right; from a wrong pose or mask; somewhere else altogether.
_SHARE_PRIOR = 0.75
_PRIOR_KINDS, _PRIOR_SHARES = ("near", "view", "mask", "elsewhere"), (0.55, 0.15, 0.2, 0.1)
# Something in front of the target; the image ends inside the crop: both only in crops.
_SHARE_OCCLUDED, _SHARE_CUT = 0.1, 0.15
# Longer side of the target as a share of the sample's side, evenly in its logarithm: in whole images, in crops, and in
# crops around a part of the target, as a first look may give them; share of those among the crops.
_SIZE_WHOLE, _SIZE_CROP, _SIZE_CLOSE = (0.06, 0.7), (0.35, 0.85), (0.85, 1.5)
_SHARE_CLOSE = 0.12
# A prior is off by this much, times a factor drawn evenly in its logarithm: place (share of the side), turn (rad) and
# logarithm of the size, each a standard deviation. The factor says how well the motion was known.
_PRIOR_PLACE, _PRIOR_TURN, _PRIOR_SIZE = 0.025, 0.05, 0.03
_PRIOR_FACTOR = (0.15, 2.0)
# Place of a prior that is somewhere else altogether, likewise.
_ELSEWHERE_PLACE = 0.35
# Black sky instead of a background; stars, up to so many, wherever it is dark.
_SHARE_SKY, _SHARE_STARS, _MAX_STARS = 0.35, 0.5, 60
# Light from a source outside or within the image.
_SHARE_STRAY = 0.15
# Monochrome cameras; motion blur; compression; a response that is a power and not that of sRGB.
_SHARE_GREY, _SHARE_SMEARED, _SHARE_JPEG, _SHARE_POWER = 0.45, 0.1, 0.6, 0.2
_JPEG_QUALITY = (35, 97)
# Noise of the sensor: electrons at white, and read noise as a share of white, both evenly in their logarithm.
_FULL_WELL = (1500.0, 20000.0)
_READ_NOISE = (2e-4, 0.012)
# Standard deviations of the natural logarithm of brightness: of target and background each, and of the exposure.
_TARGET_SPREAD, _BACKGROUND_SPREAD, _EXPOSURE_SPREAD = 0.35, 0.4, 0.5
# sRGB levels of linear light in steps fine enough for the darkest of them.
_SRGB = srgb_from_linear(np.linspace(0, 1, 4096))


@dataclass(frozen=True, eq=False)
class Sample:
    """What the network is shown, and what is true.

    Attributes:
        rgb: (S, S, 3) uint8.
        prior: (S / PRIOR_STRIDE, S / PRIOR_STRIDE) float32: +0.5 inside the silhouette expected, -0.5 outside; 0
            everywhere without one.
        target: (S, S) float32 probability that a pixel is target: its coverage; one half behind an occluder.
        weight: (S, S) float32, 0 where the image has no data.
    """

    rgb: UInt8
    prior: Float32
    target: Float32
    weight: Float32


class Composer:
    """Makes samples by number; the same views, backgrounds, seed and number give the same sample.

    Args:
        views: of the training craft.
        backgrounds: (B, H, W, 3) uint8.
        seed: of everything drawn here.
        side_px: of a sample.
    """

    def __init__(self, views: Views, backgrounds: UInt8, seed: int, side_px: int = 160) -> None:
        self._views, self._backgrounds = views, backgrounds
        self._seed, self._side = seed, side_px

    def sample(self, number: int) -> Sample:
        """The sample of a number; any number has one."""
        rng = np.random.default_rng([self._seed, number])
        side = self._side
        empty, whole = rng.random() < _SHARE_EMPTY, rng.random() < _SHARE_WHOLE
        chosen = int(rng.integers(len(self._views)))
        view = self._views.view(chosen)
        placed = self._place(view.shape[:2], whole, rng)
        radiance, coverage = _warped(view, placed, side)
        if empty:
            radiance[:], coverage[:] = 0, 0
        image = radiance * np.exp(rng.normal(0, _TARGET_SPREAD)) + self._background(rng) * (1 - coverage[..., None])
        truth = coverage
        if rng.random() < _SHARE_OCCLUDED and not whole:
            image, truth = self._occlude(image, coverage, rng)
        image = _stray_light(image, rng) if rng.random() < _SHARE_STRAY else image
        rgb = _expose(image, coverage, rng)
        weight = np.ones((side, side), np.float32)
        if not whole and rng.random() < _SHARE_CUT:
            _cut(rgb, truth, weight, rng)
        prior = np.zeros((side // PRIOR_STRIDE, side // PRIOR_STRIDE), np.float32)
        if not whole and rng.random() < _SHARE_PRIOR:
            prior = self._prior(chosen, placed, rng)
        return Sample(rgb, prior, truth, weight)

    def _place(self, size: tuple[int, int], whole: bool, rng: np.random.Generator) -> Float:
        """(2, 3) affine map from pixels of the view to those of the sample: size, mirror image, turn and place."""
        height, width = size
        close = not whole and rng.random() < _SHARE_CLOSE
        share = np.exp(rng.uniform(*np.log(_SIZE_WHOLE if whole else _SIZE_CLOSE if close else _SIZE_CROP)))
        scale = share * self._side / max(height, width)
        angle = rng.uniform(0, 2 * np.pi)
        A = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        if rng.random() < 0.5:
            A[:, 0] *= -1
        free = 0.5 * self._side * (1 - 0.6 * share) if whole else 0.12 * self._side
        center = 0.5 * self._side + rng.uniform(-free, free, 2)
        return np.column_stack([A, center - A @ (0.5 * np.array([width, height]))])

    def _background(self, rng: np.random.Generator) -> Float32:
        """(S, S, 3) linear light."""
        side = self._side
        out = np.zeros((side, side, 3), np.float32)
        if rng.random() > _SHARE_SKY:
            picture = self._backgrounds[rng.integers(len(self._backgrounds))]
            height, width = picture.shape[:2]
            scale = np.exp(rng.uniform(np.log(side / height), np.log(2.5)))
            span = int(side / scale)
            y, x = int(rng.integers(height - span + 1)), int(rng.integers(width - span + 1))
            part = decode(np.asarray(picture[y : y + span, x : x + span]))
            out = np.asarray(cv2.resize(part, (side, side), interpolation=cv2.INTER_LINEAR), np.float32)
            if rng.random() < 0.5:
                out = out[:, ::-1].copy()
            out *= np.float32(np.exp(rng.normal(0, _BACKGROUND_SPREAD)))
        if rng.random() < _SHARE_STARS:
            count = int(np.exp(rng.uniform(0, np.log(_MAX_STARS))))
            rows, columns = rng.integers(side, size=(2, count))
            dark = out[rows, columns].sum(axis=1) < 0.01
            out[rows, columns] += (dark * 0.03 * rng.pareto(1.3, count).clip(0, 60))[:, None].astype(np.float32)
        return out

    def _occlude(self, image: Float32, coverage: Float32, rng: np.random.Generator) -> tuple[Float32, Float32]:
        """Image and truth with something in front of the target; left as they are where there is none."""
        shape = np.zeros(coverage.shape, np.float32)
        ys, xs = np.nonzero(coverage > 0.5)
        if not len(ys):
            return image, coverage
        at = int(rng.integers(len(ys)))
        size = self._side * rng.uniform(0.05, 0.4)
        box = ((float(xs[at]), float(ys[at])), (size, size * rng.uniform(0.15, 2.0)), rng.uniform(0, 180))
        cv2.fillPoly(shape, [np.rint(cv2.boxPoints(box)).astype(np.int32)], 1.0, cv2.LINE_AA)
        paint = self._background(rng) if rng.random() < 0.6 else rng.uniform(0, 0.6, 3).astype(np.float32)
        image = image * (1 - shape[..., None]) + paint * shape[..., None]
        return image, np.where(shape > 0.5, np.where(coverage > 0.5, np.float32(0.5), 0), coverage).astype(np.float32)

    def _prior(self, chosen: int, placed: Float, rng: np.random.Generator) -> Float32:
        """A silhouette as a prediction or the previous mask would give it; ``placed`` is the true map of the view."""
        kind = rng.choice(_PRIOR_KINDS, p=_PRIOR_SHARES)
        view = self._views.view(self._views.another(chosen, rng) if kind == "view" else chosen)
        if kind == "elsewhere":
            view = self._views.view(int(rng.integers(len(self._views))))
        off = np.exp(rng.uniform(*np.log(_PRIOR_FACTOR)))
        reach = _ELSEWHERE_PLACE if kind == "elsewhere" else _PRIOR_PLACE * off
        side = self._side // PRIOR_STRIDE
        turn, size = rng.normal(0, _PRIOR_TURN * off), np.exp(rng.normal(0, _PRIOR_SIZE * off))
        J = size * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        middle = placed[:, :2] @ (0.5 * np.array(self._views.view(chosen).shape[1::-1])) + placed[:, 2]
        A = J @ placed[:, :2] / PRIOR_STRIDE
        center = (middle + rng.normal(0, reach * self._side, 2)) / PRIOR_STRIDE
        M = np.column_stack([A, center - A @ (0.5 * np.array(view.shape[1::-1]))])
        alpha = np.ascontiguousarray(view[..., 3]).astype(np.float32) / 255.0
        out = np.asarray(cv2.warpAffine(alpha, M, (side, side), flags=cv2.INTER_AREA), np.float32)
        if kind == "mask":
            out = _damaged(out, rng)
        return out - np.float32(0.5)


def _warped(view: UInt8, M: Float, side: int) -> tuple[Float32, Float32]:
    """Radiance (S, S, 3), premultiplied, and coverage (S, S) of a view under an affine map."""
    scale = float(np.sqrt(abs(np.linalg.det(M[:, :2]))))
    linear = np.empty((*view.shape[:2], 4), np.float32)
    linear[..., :3] = decode(np.asarray(view[..., :3]))
    linear[..., 3] = view[..., 3] * np.float32(1 / 255)
    if scale < 0.5:  # the warp samples points, so what is reduced is averaged first
        factor = int(1 / scale)
        height, width = (max(2, n // factor) for n in view.shape[:2])
        ratio = np.array([view.shape[1] / width, view.shape[0] / height])
        linear = np.asarray(cv2.resize(linear, (width, height), interpolation=cv2.INTER_AREA), np.float32)
        M = np.column_stack([M[:, :2] * ratio, M[:, 2]])
    out = np.asarray(cv2.warpAffine(linear, M, (side, side), flags=cv2.INTER_LINEAR), np.float32)
    return out[..., :3], out[..., 3]


def _damaged(mask: Float32, rng: np.random.Generator) -> Float32:
    """A mask with faults: swollen or shrunk, a piece missing, a piece too many."""
    size = 2 * int(rng.integers(0, 3)) + 1
    kernel = np.ones((size, size), np.uint8)
    out = cv2.dilate(mask, kernel) if rng.random() < 0.5 else cv2.erode(mask, kernel)
    for value in (0.0, 1.0):
        if rng.random() < 0.5:
            ys, xs = np.nonzero(mask > 0.5)
            if len(ys):
                at = int(rng.integers(len(ys)))
                axes = rng.uniform(0.05, 0.3, 2) * len(mask)
                cv2.ellipse(out, ((float(xs[at]), float(ys[at])), tuple(axes.tolist()), rng.uniform(0, 180)), value, -1)
    return np.asarray(out, np.float32)


def _stray_light(image: Float32, rng: np.random.Generator) -> Float32:
    """A glow from a side, or an even veil."""
    side = len(image)
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    cx, cy = rng.uniform(-0.5, 1.5, 2) * side
    distance = np.hypot(x - cx, y - cy) / (side * np.exp(rng.uniform(*np.log((0.1, 1.5)))))
    glow = np.exp(rng.uniform(*np.log((0.01, 1.0)))) * np.exp(-distance)
    return image + glow[..., None].astype(np.float32) * rng.uniform(0.7, 1.0, 3).astype(np.float32)


def _expose(image: Float32, coverage: Float32, rng: np.random.Generator) -> UInt8:
    """Optics, sensor and compression."""
    image = image * np.float32(np.exp(rng.normal(0.0, _EXPOSURE_SPREAD)))
    monochrome = rng.random() < _SHARE_GREY
    if monochrome:
        image = (image @ rng.dirichlet((3, 5, 2)).astype(np.float32))[..., None]
    blur = rng.uniform(0.0, 1.3) if rng.random() < 0.9 else rng.uniform(1.3, 2.5)
    if blur > 0.25:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur), np.float32).reshape(image.shape)
    if rng.random() < _SHARE_SMEARED:
        image = _smeared(image, rng)
    read = np.exp(rng.uniform(*np.log(_READ_NOISE)))
    well = np.exp(rng.uniform(*np.log(_FULL_WELL)))
    sigma = np.sqrt(np.float32(read**2) + np.clip(image, 0, 1) / np.float32(well))
    image = image + sigma * rng.standard_normal(image.shape, dtype=np.float32)
    image += np.float32(max(0.0, rng.normal(0, 0.002)))  # floor of the sensor
    if rng.random() < _SHARE_POWER:
        pixels = (255 * np.clip(image, 0, 1) ** np.float32(1 / rng.uniform(1.0, 2.6)) + 0.5).astype(np.uint8)
    else:
        pixels = _SRGB[(np.clip(image, 0, 1) * np.float32(len(_SRGB) - 1) + np.float32(0.5)).astype(np.int32)]
    if monochrome:
        pixels = np.repeat(pixels.reshape(*coverage.shape, 1), 3, axis=2)
    if rng.random() < _SHARE_JPEG:
        quality = int(rng.integers(*_JPEG_QUALITY))
        data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        pixels = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    return pixels


def _smeared(image: Float32, rng: np.random.Generator) -> Float32:
    """Motion blur along a line."""
    length = int(rng.integers(2, 7))
    kernel = np.zeros((2 * length + 1, 2 * length + 1), np.float32)
    angle = rng.uniform(0, np.pi)
    step = length * np.array([np.cos(angle), np.sin(angle)])
    ends = [tuple(np.rint(length + sign * step).astype(int).tolist()) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0, 1)
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), np.float32).reshape(image.shape)


def _cut(rgb: UInt8, truth: Float32, weight: Float32, rng: np.random.Generator) -> None:
    """The image ends inside the crop: beyond its border there is nothing, and nothing to be told."""
    n = int(rng.integers(1, len(rgb) // 3))
    beyond = (np.s_[:n], np.s_[-n:], np.s_[:, :n], np.s_[:, -n:])[rng.integers(4)]
    rgb[beyond], truth[beyond], weight[beyond] = 0, 0, 0
