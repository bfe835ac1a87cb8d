"""The view bank of a CAD model: what its silhouette looks like from everywhere, in a form that is cheap to compare.

Each view keeps its silhouette on a polar grid about its own centroid, scaled by its radius of gyration and Fourier
transformed over the polar angle, so that turning the camera about its axis is a multiplication by a phase; and a
sparse set of contour points in 3-D, from which a pose can be refined without rendering. Built once per model in about
two seconds and kept in the platform's cache folder.

Booms and antennas can be left out of both sides of the comparison. They have much outline and little area; before a
black sky they show, before anything else a mask hardly ever has them, and then contour points on them would drag a pose
towards a part of the mask that they do not belong to.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import Bool, Float, Float32
from hat_ros.cache import cached_arrays
from hat_ros.target.contour import COL_WEIGHT, contour_table
from hat_ros.target.model import Target
from hat_ros.target.rendering import Renderer
from hat_ros.types import Camera

# Raised whenever the content of a bank changes its meaning: older cache files are then not found.
_FORMAT = 1
N_RINGS = 32
# Outer radius of the polar grid in radii of gyration: the far end of a lopsided slender body lies at about 2.5.
MAX_RADIUS = 2.6
CONTOUR_POINTS = 96
# Distance of the virtual camera in bounding radii: far enough that perspective matters little, near enough to be real.
_DISTANCE_RADII = 8.0
_RENDER_PX = 112
# Parts of a silhouette narrower than about twice this share of its longer side are thin, unless this much of its area
# is: then it is a thin body that is seen.
_THIN_SHARE = 0.013
_THIN_BODY_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class ViewBank:
    """Silhouettes of one target from V directions, F = n_angles // 2 + 1 Fourier coefficients, P contour points.

    Attributes:
        R_cam_target: (V, 3, 3) orientation of each view, the camera looking at the centre of the target.
        spectrum: (F, V, rings) complex64 polar silhouettes, transformed over the angle.
        area: (V,) area of the polar silhouette, in the unit of an inner product of two grids.
        gyration: (V,) radius of gyration, tangent units at the view's distance.
        centroid: (V, 2) silhouette centroid, tangent units, from the projected centre.
        contour_m: (V, P, 3) contour points in the target frame.
        contour_weight: (V, P) contour length each stands for, zero where unused.
        distance_m: () distance of the virtual camera from the centre.
    """

    R_cam_target: Float
    spectrum: NDArray[np.complex64]
    area: Float32
    gyration: Float
    centroid: Float
    contour_m: Float
    contour_weight: Float
    distance_m: Float

    @property
    def n_angles(self) -> int:
        """Number of in-plane angles."""
        return 2 * (self.spectrum.shape[0] - 1)


def load_or_build(target: Target, renderer: Renderer, n_views: int, n_angles: int, thin_parts: bool = True) -> ViewBank:
    """The bank of a target from the cache folder, built and stored there when it is absent or damaged."""
    grid = f"{n_angles}:{N_RINGS}:{MAX_RADIUS}:{CONTOUR_POINTS}:{_DISTANCE_RADII}:{_RENDER_PX}"
    thin = "" if thin_parts else f":{_THIN_SHARE}:{_THIN_BODY_SHARE}"
    arrays = cached_arrays(
        "views",
        f"{target.sha256}:{_FORMAT}:{n_views}:{grid}{thin}",
        lambda: vars(build(target, renderer, n_views, n_angles, thin_parts)),
    )
    return ViewBank(**arrays)


def build(target: Target, renderer: Renderer, n_views: int, n_angles: int, thin_parts: bool = True) -> ViewBank:
    """Render every view and describe it, with or without its thin parts.

    ``n_views``: an icosphere size (162, 642, 2562); ``n_angles`` even.
    """
    rotations = view_rotations(n_views)
    center, radius = target.center_m, target.bounding_radius_m
    distance = _DISTANCE_RADII * radius
    focal = 0.5 * (_RENDER_PX - 6) / np.tan(np.arcsin(1.0 / _DISTANCE_RADII))
    K = np.array([[focal, 0, _RENDER_PX / 2 - 0.5], [0, focal, _RENDER_PX / 2 - 0.5], [0, 0, 1]])
    camera = Camera(K, _RENDER_PX, _RENDER_PX)
    rings = np.zeros((n_views, n_angles, N_RINGS), np.float32)
    gyration, centroid = np.ones(n_views), np.zeros((n_views, 2))
    contour, weight = np.zeros((n_views, CONTOUR_POINTS, 3)), np.zeros((n_views, CONTOUR_POINTS))
    for i, R in enumerate(rotations):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, np.array([0, 0, distance]) - R @ center
        view = renderer.render(T, camera, color=False)
        if not view.mask.any():  # a flat body seen exactly edge-on
            continue
        shape = view.mask if thin_parts else without_thin_parts(view.mask)
        center_px, gyration_px = mask_moments(shape)
        rings[i] = polar_grid(shape.astype(np.float32), center_px, gyration_px, n_angles)
        gyration[i] = gyration_px / focal
        centroid[i] = (center_px - K[:2, 2]) / focal
        table = contour_table(view.depth_m, shape, K, CONTOUR_POINTS)
        contour[i, : len(table)] = (table[:, :3] - T[:3, 3]) @ R
        weight[i, : len(table)] = table[:, COL_WEIGHT]
    spectrum = np.ascontiguousarray(np.fft.rfft(rings, axis=1).transpose(1, 0, 2).astype(np.complex64))
    area = (rings @ ring_weights()).sum(axis=1)
    return ViewBank(rotations, spectrum, area, gyration, centroid, contour, weight, np.array(distance))


def without_thin_parts(mask: Bool) -> Bool:
    """A silhouette (H, W) with at least one pixel, its booms and antennas left out."""
    silhouette = np.ascontiguousarray(mask).view(np.uint8)
    x, y, width, height = cv2.boundingRect(silhouette)
    radius = round(_THIN_SHARE * max(width, height))
    if radius == 0:
        return mask
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    part = np.s_[y : y + height, x : x + width]
    body = np.zeros_like(mask)
    body[part] = cv2.morphologyEx(silhouette[part], cv2.MORPH_OPEN, kernel) > 0
    return body if np.count_nonzero(body) >= (1.0 - _THIN_BODY_SHARE) * np.count_nonzero(mask) else mask


def mask_moments(mask: Bool) -> tuple[Float, float]:
    """Centroid (2,) and radius of gyration of a mask with at least one pixel, pixels."""
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    x0, y0 = int(cols[0]), int(rows[0])
    m = cv2.moments(np.ascontiguousarray(mask[y0 : rows[-1] + 1, x0 : cols[-1] + 1], np.uint8), binaryImage=True)
    area = m["m00"]
    # A pixel is a square, so even a single one has a radius of gyration: 1/12 of its side squared per axis.
    spread = (m["mu20"] + m["mu02"]) / area + 1.0 / 6.0
    return np.array([m["m10"] / area + x0, m["m01"] / area + y0]), float(np.sqrt(spread))


def image_moments(image: Float32) -> tuple[Float, float]:
    """Centroid (2,) and radius of gyration of the light in an image that is not black, pixels."""
    m = cv2.moments(image)
    spread = (m["mu20"] + m["mu02"]) / m["m00"] + 1.0 / 6.0
    return np.array([m["m10"], m["m01"]]) / m["m00"], float(np.sqrt(spread))


def polar_grid(image: Float32, center_px: Float, gyration_px: float, n_angles: int) -> Float32:
    """Sample an image, black beyond its border, on rings about a centre: (n_angles, rings), weighted.

    Each sample carries the square root of its area, so that the inner product of two grids is an area of overlap and
    both sides of the product are weighted alike.
    """
    return PolarSampler(image).grid(center_px, gyration_px, n_angles)


class PolarSampler:
    """Samples one image on many polar grids; see :func:`polar_grid`.

    Args:
        image: (H, W) float32; only the part that is not black is looked at.
    """

    def __init__(self, image: Float32) -> None:
        self._image = image
        self._left, self._top, self._width, self._height = cv2.boundingRect((image != 0).view(np.uint8))
        self._averaged: dict[int, tuple[Float32, int, int]] = {}

    def grid(self, center_px: Float, gyration_px: float, n_angles: int) -> Float32:
        """(n_angles, rings) about a centre, pixels."""
        radius, angle = _polar(gyration_px, n_angles)
        image, left, top = self._average(int(gyration_px * MAX_RADIUS / N_RINGS))
        x = (center_px[0] - left + radius * np.cos(angle)).astype(np.float32)
        y = (center_px[1] - top + radius * np.sin(angle)).astype(np.float32)
        return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) * ring_weights()

    def _average(self, step_px: int) -> tuple[Float32, int, int]:
        """What lies between two samples averaged: the part of the image that is not black then, and its corner."""
        if step_px not in self._averaged:
            left, top = max(self._left - step_px, 0), max(self._top - step_px, 0)
            part = self._image[top : self._top + self._height + step_px, left : self._left + self._width + step_px]
            if step_px > 1:
                part = cv2.blur(part, (step_px, step_px), borderType=cv2.BORDER_REPLICATE)
            self._averaged[step_px] = part, left, top
        return self._averaged[step_px]


def border_grid(shape: tuple[int, ...], center_px: Float, gyration_px: float, n_angles: int) -> Float32:
    """The :func:`polar_grid` of an image (H, W) of ones: what of the grid lies inside the image."""
    radius, angle = _polar(gyration_px, n_angles)
    inside = np.ones((n_angles, N_RINGS))
    for middle, size, direction in zip(center_px, shape[::-1], (np.cos(angle), np.sin(angle)), strict=True):
        at = middle + radius * direction
        inside *= np.clip(np.minimum(at + 1.0, size - at), 0.0, 1.0)
    return inside.astype(np.float32) * ring_weights()


def _polar(gyration_px: float, n_angles: int) -> tuple[Float, Float]:
    """Radii (rings,) of a polar grid, pixels, and its angles (n_angles, 1), radians."""
    radius_px = (np.arange(N_RINGS) + 0.5) * (gyration_px * MAX_RADIUS / N_RINGS)
    return radius_px, (np.arange(n_angles) * (2.0 * np.pi / n_angles))[:, None]


def ring_weights() -> Float32:
    """(rings,) square root of the area of a sample on each ring, up to a common factor."""
    return np.sqrt((np.arange(N_RINGS) + 0.5) * (MAX_RADIUS / N_RINGS)).astype(np.float32)


def view_rotations(n_views: int) -> Float:
    """(n_views, 3, 3) ``R_cam_target`` looking at the target from the vertices of a subdivided icosahedron."""
    directions = _icosphere(n_views)  # from the target to the camera
    z = -directions
    helper = np.where(np.abs(z[:, 2:]) < 0.9, np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 1.0, 0.0]]))
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _icosphere(n_vertices: int) -> Float:
    """Unit vertices of an icosahedron whose edges are halved until it has ``10 * 4^n + 2`` vertices."""
    g = (1.0 + np.sqrt(5.0)) / 2.0
    vertices = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g)]
    vertices += [(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    points = [np.array(v) / np.linalg.norm(v) for v in vertices]
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6)]
    faces += [(7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10)]
    faces += [(8, 6, 7), (9, 8, 1)]
    while len(points) < n_vertices:
        middle: dict[tuple[int, int], int] = {}
        finer = []
        for face in faces:
            mids = []
            for a, b in zip(face, face[1:] + face[:1], strict=True):
                edge = (min(a, b), max(a, b))
                if edge not in middle:
                    middle[edge] = len(points)
                    sum_ab = points[a] + points[b]
                    points.append(sum_ab / np.linalg.norm(sum_ab))
                mids.append(middle[edge])
            finer += [(face[i], mids[i], mids[i - 1]) for i in range(3)] + [tuple(mids)]
        faces = finer
    return np.array(points)
