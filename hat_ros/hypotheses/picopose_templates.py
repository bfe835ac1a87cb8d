"""The 162 rendered templates that PicoPose and GigaPose compare an image with."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import Bool, Float, Float32, UInt8
from hat_ros.geometry import lie
from hat_ros.target.model import Target
from hat_ros.target.network_views import NetworkViewRenderer
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.rays import pixel_rays
from hat_ros.target.sphere import look_inwards_upright
from hat_ros.types import Camera

LOG = logging.getLogger(__name__)

TEMPLATE_K = np.array([[572.4114, 0.0, 320.0], [0.0, 573.57043, 240.0], [0.0, 0.0, 1.0]])
TEMPLATE_SIZE = (640, 480)
CROP_PX = 224
POINT_CELLS = 64
_N_TEMPLATES = 162
# Focal length over distance that shows a ball of unit diameter 360 px large at the published focal length.
_PIXELS_PER_RADIUS = 180.0


@dataclass(frozen=True)
class SquareCrop:
    """A square crop of an image, resized to 224 px.

    Attributes:
        x0: first column. y0: first row. side: pixels a side, even.
    """

    x0: int
    y0: int
    side: int

    @property
    def M(self) -> Float:
        """(3, 3) affine from image pixels to crop pixels (pixel edges at integers, as the published crops)."""
        s = CROP_PX / self.side
        return np.array([[s, 0, -s * self.x0], [0, s, -s * self.y0], [0, 0, 1.0]])

    def cut(self, image: NDArray) -> NDArray:
        """The square at the image's own resolution."""
        return image[self.y0 : self.y0 + self.side, self.x0 : self.x0 + self.side]

    def resize(self, image: UInt8) -> Float32:
        """(H, W, 3) RGB -> (3, 224, 224) BGR in [0, 1], bilinear."""
        cut = np.ascontiguousarray(self.cut(image)[..., ::-1], np.float32) / 255
        resized = np.asarray(cv2.resize(cut, (CROP_PX, CROP_PX), interpolation=cv2.INTER_LINEAR), np.float32)
        return resized.transpose(2, 0, 1)

    def resize_mask(self, mask: Bool) -> Float32:
        """(H, W) -> (224, 224) of 0 and 1, nearest."""
        return _nearest(self.cut(mask).astype(np.float32), CROP_PX)


def square_crop(mask: Bool) -> SquareCrop:
    """Square around a mask's tight box, as large as its longer side, shifted to stay inside the image.

    ``mask`` is (H, W) with at least one pixel set.
    """
    height, width = mask.shape
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    y0, y1, x0, x1 = rows[0], rows[-1] + 1, cols[0], cols[-1] + 1
    half = max(min(max(y1 - y0, x1 - x0), height, width) // 2, 1)
    top = min(max(int((y0 + y1) / 2) - half, 0), height - 2 * half)
    left = min(max(int((x0 + x1) / 2) - half, 0), width - 2 * half)
    return SquareCrop(int(left), int(top), int(2 * half))


@dataclass(frozen=True)
class Templates:
    """What the networks need of the 162 views.

    Attributes:
        crops: (N, 3, 224, 224) float32 BGR in [0, 1].
        masks: (N, 224, 224) float32 of 0 and 1.
        M: (N, 3, 3) crop matrices.
        T_cam_target: (N, 4, 4).
        points_m: (N, 64, 64, 3) float32 target-frame surface point of each crop cell, NaN off the target.
    """

    crops: Float32
    masks: Float32
    M: Float
    T_cam_target: Float
    points_m: Float32


def template_poses(target: Target) -> Float:
    """(162, 4, 4) poses that centre the target's box and show its bounding ball about 360 px large."""
    R = look_inwards_upright(_N_TEMPLATES)
    distance = 2 * target.bounding_radius_m * TEMPLATE_K[1, 1] / (2 * _PIXELS_PER_RADIUS)
    return lie.transform(R, np.array([0.0, 0.0, distance]) - R @ target.center_m)


def render_templates(target: Target) -> Templates:
    """Render, crop and lift all views: a few seconds on one core."""
    looks, shapes = NetworkViewRenderer(target), RayRenderer(target)
    # Panda3D applies K with pixel centres at +0.5, ours lie at integers.
    K = TEMPLATE_K.copy()
    K[:2, 2] -= 0.5
    camera = Camera(K, *TEMPLATE_SIZE)
    poses = template_poses(target)
    LOG.info("rendering %d templates, once per CAD model", len(poses))
    crops, masks, Ms, points = [], [], [], []
    for T in poses:
        view = shapes.render(T, camera, color=False)
        crop = square_crop(view.mask)
        rgb = looks.render(T, TEMPLATE_K, TEMPLATE_SIZE)[..., :3]
        crops.append(crop.resize(rgb))
        masks.append(crop.resize_mask(view.mask))
        Ms.append(crop.M)
        points.append(_surface_points(view.depth_m, crop, camera, T))
    return Templates(np.stack(crops), np.stack(masks), np.stack(Ms), poses, np.stack(points))


def _surface_points(depth_m: Float32, crop: SquareCrop, camera: Camera, T_cam_target: Float) -> Float32:
    """(64, 64, 3) target-frame points under the crop's cells, NaN off the target."""
    rays = pixel_rays(camera, np.arange(camera.width), np.arange(camera.height))
    depth = _nearest(crop.cut(depth_m), POINT_CELLS)
    points = _nearest(crop.cut(rays), POINT_CELLS) * depth[..., None]
    points = (points - T_cam_target[:3, 3]) @ T_cam_target[:3, :3]
    return np.where(depth[..., None] > 0, points, np.nan).astype(np.float32)


def _nearest(image: NDArray, side: int) -> NDArray:
    """Nearest-neighbour resize to a square, sampling pixel floor(i * n / side)."""
    rows = np.arange(side) * image.shape[0] // side
    cols = np.arange(side) * image.shape[1] // side
    return image[rows[:, None], cols[None]]
