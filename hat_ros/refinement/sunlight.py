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

from hat_ros.array_types import Bool, Float, Float32, UInt8
from hat_ros.refinement.view import Surfels, TargetViewer, View
from hat_ros.target.sphere import even_directions

# Points of the surface along the longer side of what is compared.
_SIDE_POINTS = 48
# The image is smoothed over this share of the mask's longer side: a little more than from point to point.
_SMOOTH_SHARE = 1 / 38
# Samples along a side of the box of the mask, of what is bright beside the silhouette.
_SIDE_SAMPLES = 96
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
    to_sun_cam: Float


class LightField:
    """What of an image is compared with shaded models.

    Attributes:
        image: (H, W, 3) uint8.
        mask: (H, W) bool; what is bright in it beside a silhouette counts against a pose.
        box: (x, y, width, height) of the mask.
        smooth: (H, W, 3) uint8 image whose pixels stand for what lies between them in the comparison.
    """

    def __init__(self, image: UInt8, mask: Bool) -> None:
        self.image = image
        self.mask = mask
        left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
        self.box = (left, top, width, height)
        width_px = max(1, round(_SMOOTH_SHARE * max(width, height)))
        self.smooth = cv2.blur(image, (width_px, width_px))


@dataclass(frozen=True, eq=False)
class _Scene:
    """What is seen where the target would be.

    Attributes:
        seen: the target's surface, point by point.
        observed: (M, 3) colours of the image there.
        beside: sum of what is bright in the mask beside it, as if it were seen in points as dense.
    """

    seen: Surfels
    observed: Float32
    beside: float


class SunMatcher:
    """Fits sunlight to poses of one target."""

    def __init__(self, viewer: TargetViewer) -> None:
        self._viewer = viewer
        suns = even_directions(_N_SUNS)
        self._suns = suns[suns[:, 2] < _MAX_BEHIND].astype(np.float32)
        self._encoded = brightness(np.linspace(0.0, 1.0, 257, dtype=np.float32))
        self._warm_up()

    def match(self, view: View, field: LightField) -> Sunlight | None:
        """The sunlight in which a view of the target looks most like the image, None when it is out of the image."""
        scene = self._scene(view, field)
        if scene is None:
            return None
        R, seen, albedo = view.T_cam_target[:3, :3], scene.seen, scene.seen.rgb.astype(np.float32)
        trial = self._trial(scene, R, self._suns, _TRIAL_PIXELS)
        promising = self._suns[np.argsort(trial, kind="stable")[:_N_SHADOWED]]
        cosine = (self._viewer.sunlit(seen.points_m, seen.normals, sun) for sun in promising @ R.astype(np.float32))
        distance = [_distance(c, albedo, scene.observed, scene.beside, self._encoded) for c in cosine]
        best = int(np.argmin(distance))
        return Sunlight(float(distance[best]), promising[best].astype(np.float64))

    def _trial(self, scene: _Scene, R_cam_target: Float, suns: Float32, max_pixels: int) -> NDArray:
        """Distance (S,) under each sun, without cast shadows, over at most about so many pixels in grey."""
        step = max(1, len(scene.seen.pixel) // max_pixels)
        normals = scene.seen.normals[::step] @ R_cam_target.T.astype(np.float32)
        albedo = scene.seen.rgb[::step].astype(np.float32).mean(axis=1)
        return _trial(
            normals, albedo, scene.observed[::step].mean(axis=1), scene.beside / (3 * step), suns, self._encoded
        )

    def _scene(self, view: View, field: LightField) -> _Scene | None:
        """What the image shows where the view's grid of rays sees the target, None when that is out of the image."""
        height, width = field.mask.shape
        rows, cols = view.mask.shape[0] // 2, view.mask.shape[1] // 2
        step = -(-max(rows, cols) // _SIDE_POINTS)
        row, col = np.arange(0, rows, step), np.arange(0, cols, step)
        spacing_px = 2 / view.scale
        u = np.rint(view.origin_px[0] + col * spacing_px).astype(np.intp)
        v = np.rint(view.origin_px[1] + row * spacing_px).astype(np.intp)
        in_u, in_v = (u >= 0) & (u < width), (v >= 0) & (v < height)
        u, v, row, col = u[in_u], v[in_v], row[in_v], col[in_u]
        seen = self._viewer.surfels(view, (row[:, None] * cols + col).ravel())
        if not len(seen.pixel):
            return None
        observed = field.smooth[v[:, None], u].reshape(-1, 3)[seen.pixel].astype(np.float32)
        beside = _light_beside(field.image, field.mask, field.box, view.mask, view.origin_px, view.scale)
        return _Scene(seen, observed, beside / (step * spacing_px) ** 2)

    def _warm_up(self) -> None:
        """Fit sunlight to a made-up view of the target, so that everything is compiled before the first frame."""
        side = 4 * _SIDE_POINTS
        camera, T = self._viewer.made_up(side)
        view = self._viewer.view(T, camera, 2 * _SIDE_POINTS)
        if view is not None:
            self.match(view, LightField(np.full((side, side, 3), 255, np.uint8), np.ones((side, side), np.bool_)))


def brightness(cosine: Float32) -> Float32:
    """Encoded brightness of a white face over the cosine of the sun's incidence."""
    return (cosine + np.float32(_AMBIENT)) ** np.float32(_GAMMA)


@njit(cache=True, nogil=True)
def _light_beside(
    image: UInt8,
    mask: Bool,
    box: tuple[int, int, int, int],
    silhouette: Bool,
    origin_px: Float,
    scale: float,
) -> float:
    """Sum over colours and pixels of what is bright in a mask, in a box (x, y, width, height), beside a silhouette."""
    left, top, width, height = box
    stride = max(1, max(width, height) // _SIDE_SAMPLES)
    rows, cols = silhouette.shape
    total = 0.0
    for y in range(top, top + height, stride):
        r = int(np.floor((y - origin_px[1]) * scale + 0.5))
        for x in range(left, left + width, stride):
            if not mask[y, x]:
                continue
            c = int(np.floor((x - origin_px[0]) * scale + 0.5))
            if not (0 <= r < rows and 0 <= c < cols and silhouette[r, c]):
                total += float(image[y, x, 0]) + float(image[y, x, 1]) + float(image[y, x, 2])
    return total * stride * stride


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
