"""How well a pose explains what is bright and what is dark: the image against the CAD model in the best sunlight.

In space one hard sun makes the picture. Whatever its direction, a pose fixes which way every visible face looks and
what shades it, so a right pose finds a sun under which shading, shadows and colours of the CAD model resemble the
image, and a wrong one does not. Direction and exposure are fitted; gloss, interreflection and surfaces that the model
gets wrong stay as residuals, which is why only the comparison between poses means something.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from hat_ros.refinement.view import Surfels, TargetViewer
from hat_ros.render.embree import pixel_rays
from hat_ros.types import Camera, Frame

Float32 = NDArray[np.float32]

# Longer side of the reduced image that is compared, pixels.
_SIDE_PX = 48
# Directions of the sun tried at first, and how far behind the target they reach.
_N_SUNS = 140
_MAX_BEHIND = 0.75
# Pixels of that first trial, which leaves out cast shadows; the best directions are tried with them.
_TRIAL_PIXELS = 400
_N_SHADOWED = 3
# Light that reaches a shadowed face, as a share of the sun's; exponent of the image's encoding.
_AMBIENT = 0.003
_GAMMA = 1.0 / 2.2
# Grey levels below which a residual is noise.
_NOISE_LEVEL = 8.0


@dataclass(frozen=True)
class Sunlight:
    """The best sunlight for a pose.

    Attributes:
        distance: sum of the differences between image and prediction over the sum of both, 0 (equal) to 1.
        to_sun_cam: (3,) unit direction to the sun, camera frame.
    """

    distance: float
    to_sun_cam: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Scene:
    """What is seen where the target would be.

    Attributes:
        seen: the target's surface, pixel by pixel of a reduced image.
        observed: (M, 3) colours of the image there.
        beside: sum of what is bright in the mask beside it.
    """

    seen: Surfels
    observed: Float32
    beside: float


class SunMatcher:
    """Fits sunlight to poses of one target."""

    def __init__(self, viewer: TargetViewer) -> None:
        self._viewer = viewer
        suns = _even_directions(_N_SUNS)
        self._suns = suns[suns[:, 2] < _MAX_BEHIND].astype(np.float32)
        self._encoded = brightness(np.linspace(0.0, 1.0, 257, dtype=np.float32))

    def match(self, T_cam_target: NDArray[np.float64], frame: Frame, mask: NDArray[np.bool_]) -> Sunlight | None:
        """The sunlight in which the target at a pose looks most like the image, None when it is out of view.

        Args:
            T_cam_target: (4, 4).
            frame: the image.
            mask: (H, W) bool; what is bright in it beside the silhouette counts against the pose.
        """
        scene = self._scene(T_cam_target, frame, mask, _SIDE_PX)
        if scene is None:
            return None
        R, seen, albedo = T_cam_target[:3, :3], scene.seen, scene.seen.rgb.astype(np.float32)
        trial = self._trial(scene, R, self._suns, _TRIAL_PIXELS)
        promising = self._suns[np.argsort(trial, kind="stable")[:_N_SHADOWED]]
        cosine = self._viewer.sunlit_surfels(seen, promising @ R.astype(np.float32))
        distance = [_distance(c, albedo, scene.observed, scene.beside, self._encoded) for c in cosine]
        best = int(np.argmin(distance))
        return Sunlight(float(distance[best]), promising[best].astype(np.float64))

    def _trial(self, scene: _Scene, R_cam_target: NDArray[np.float64], suns: Float32, max_pixels: int) -> NDArray:
        """Distance (S,) under each sun, without cast shadows, over at most about so many pixels in grey."""
        step = max(1, len(scene.seen.pixel) // max_pixels)
        normals = scene.seen.normals[::step] @ R_cam_target.T.astype(np.float32)
        albedo = scene.seen.rgb[::step].astype(np.float32).mean(axis=1)
        return _trial(
            normals, albedo, scene.observed[::step].mean(axis=1), scene.beside / (3 * step), suns, self._encoded
        )

    def _scene(
        self, T_cam_target: NDArray[np.float64], frame: Frame, mask: NDArray[np.bool_], side_px: int
    ) -> _Scene | None:
        """What the reduced image shows where the target would be, None when that is out of view."""
        crop = self._crop(T_cam_target, frame.camera, mask, side_px)
        if crop is None:
            return None
        box, camera = crop
        x0, y0, x1, y1 = box
        size = (camera.width, camera.height)
        image = cv2.resize(frame.rgb[y0:y1, x0:x1], size, interpolation=cv2.INTER_AREA)
        share = cv2.resize(mask[y0:y1, x0:x1].astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA)
        R, t = T_cam_target[:3, :3], T_cam_target[:3, 3]
        rays = pixel_rays(camera, np.arange(camera.width), np.arange(camera.height)).reshape(-1, 3)
        seen = self._viewer.surface(rays @ R, -t @ R)
        if not len(seen.pixel):
            return None
        bright = image.reshape(-1, 3).astype(np.float32)
        observed = bright[seen.pixel]
        bright *= share.reshape(-1, 1) * np.float32(1 / 255)
        bright[seen.pixel] = 0.0
        return _Scene(seen, observed, float(bright.sum()))

    def _crop(
        self, T_cam_target: NDArray[np.float64], camera: Camera, mask: NDArray[np.bool_], side_px: int
    ) -> tuple[tuple[int, int, int, int], Camera] | None:
        """Image box (x0, y0, x1, y1) that holds silhouette and mask, and the camera of its reduced image."""
        bounds = self._viewer.bounds(T_cam_target, camera)
        if bounds is None:
            return None
        left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
        x0, y0 = max(min(int(bounds[0]), left), 0), max(min(int(bounds[1]), top), 0)
        x1 = min(max(int(np.ceil(bounds[2])) + 1, left + width), camera.width)
        y1 = min(max(int(np.ceil(bounds[3])) + 1, top + height), camera.height)
        if x1 - x0 < 2 or y1 - y0 < 2:
            return None
        scale = min(1.0, side_px / max(x1 - x0, y1 - y0))
        width, height = max(2, round((x1 - x0) * scale)), max(2, round((y1 - y0) * scale))
        K = camera.K.copy()
        K[0] *= width / (x1 - x0)
        K[1] *= height / (y1 - y0)
        K[0, 2] = (camera.K[0, 2] + 0.5 - x0) * width / (x1 - x0) - 0.5
        K[1, 2] = (camera.K[1, 2] + 0.5 - y0) * height / (y1 - y0) - 0.5
        return (x0, y0, x1, y1), Camera(K, width, height)


def brightness(cosine: Float32) -> Float32:
    """Encoded brightness of a white face over the cosine of the sun's incidence."""
    return (cosine + np.float32(_AMBIENT)) ** np.float32(_GAMMA)


def _even_directions(count: int) -> NDArray[np.float64]:
    """(count, 3) unit vectors spread evenly over the sphere (Fibonacci spiral)."""
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * index
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


@njit(cache=True, nogil=True)
def _trial(
    normals: Float32, albedo: Float32, observed: Float32, beside: float, suns: Float32, encoded: Float32
) -> Float32:
    """Distance (S,) of grey pixels (N,) to their prediction under each sun, without cast shadows.

    All suns side by side, pixel after pixel: so the sums of one sun do not wait for each other.
    """
    n, n_suns = len(albedo), len(suns)
    x, y, z = suns[:, 0].copy(), suns[:, 1].copy(), suns[:, 2].copy()
    predicted = np.empty((n, n_suns), np.float32)
    shade = np.empty(n_suns, np.int32)
    for i in range(n):
        for s in range(n_suns):
            cosine = normals[i, 0] * x[s] + normals[i, 1] * y[s] + normals[i, 2] * z[s]
            shade[s] = np.int32(min(max(cosine, np.float32(0.0)), np.float32(1.0)) * np.float32(256.0))
        for s in range(n_suns):
            predicted[i, s] = albedo[i] * encoded[shade[s]]
    return differences(predicted, observed, beside)


@njit(cache=True, nogil=True)
def differences(predicted: Float32, observed: Float32, beside: float) -> Float32:
    """Share of differences (S,) of pixels (N,) to predictions (N, S), each at the exposure that suits it best."""
    n, n_suns = predicted.shape
    total, gain = np.float32(0.0), np.zeros(n_suns, np.float32)
    for i in range(n):
        total += observed[i]
        gain += predicted[i]
    if total + beside <= 0.0:
        return np.ones(n_suns, np.float32)  # nothing is seen, nothing explained
    for s in range(n_suns):
        gain[s] = total / (gain[s] + np.float32(1e-6))
    noise, white = np.float32(_NOISE_LEVEL), np.float32(255.0)
    for _ in range(2):  # least absolute differences by reweighting
        top, bottom = np.zeros(n_suns, np.float32), np.full(n_suns, np.float32(1e-6))
        for i in range(n):
            bright = observed[i]
            for s in range(n_suns):
                p = predicted[i, s]
                weighted = p / (abs(bright - gain[s] * p) + noise)
                top[s] += weighted * bright
                bottom[s] += weighted * p
        for s in range(n_suns):
            gain[s] = top[s] / bottom[s]
    difference, both = np.full(n_suns, np.float32(beside)), np.full(n_suns, np.float32(beside + total + 1e-6))
    for i in range(n):
        bright = observed[i]
        for s in range(n_suns):
            p = min(gain[s] * predicted[i, s], white)
            difference[s] += abs(bright - p)
            both[s] += p
    for s in range(n_suns):
        difference[s] /= both[s]
    return difference


@njit(cache=True, nogil=True)
def _distance(cosine: Float32, albedo: Float32, observed: Float32, beside: float, encoded: Float32) -> float:
    """Share of differences (see :class:`Sunlight`) at the exposure that suits best.

    Args:
        cosine: (N,) of the sun's incidence, 0 in shadow.
        albedo: (N, C) encoded colours of the model.
        observed: (N, C) encoded colours of the image.
        beside: sum of what is bright beside the silhouette.
        encoded: (257,) encoded brightness over the cosine.
    """
    n, channels = albedo.shape
    shade = np.empty(n, np.float32)
    total, predicted = 0.0, 1e-6
    for i in range(n):
        shade[i] = encoded[int(min(cosine[i], np.float32(1.0)) * np.float32(256.0))]
        for c in range(channels):
            total += observed[i, c]
            predicted += albedo[i, c] * shade[i]
    if total + beside <= 0.0:
        return 1.0  # nothing is seen, nothing explained
    gain = total / predicted
    for _ in range(2):  # least absolute differences by reweighting
        top, bottom = 0.0, 1e-6
        for i in range(n):
            for c in range(channels):
                p = albedo[i, c] * shade[i]
                weight = 1.0 / (abs(observed[i, c] - gain * p) + _NOISE_LEVEL)
                top += weight * p * observed[i, c]
                bottom += weight * p * p
        gain = top / bottom
    difference, both = beside, beside + total + 1e-6
    for i in range(n):
        for c in range(channels):
            p = min(gain * albedo[i, c] * shade[i], 255.0)
            difference += abs(observed[i, c] - p)
            both += p
    return difference / both
