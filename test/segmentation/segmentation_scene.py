"""A small synthetic scene for the segmentation tests: a lopsided body on black sky or on a moving textured ground."""

from dataclasses import dataclass

import cv2
import numpy as np
import trimesh

from hat_ros.geometry import lie
from hat_ros.target.loading import target_from_scene
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.types import Camera, Frame, PosePrior

WIDTH, HEIGHT = 320, 240
CAMERA = Camera(np.array([[400.0, 0, 159.5], [0, 400.0, 119.5], [0, 0, 1]]), WIDTH, HEIGHT)


def build_target():
    body = trimesh.creation.box((1.0, 0.7, 0.6))
    wing = trimesh.creation.box((1.4, 0.05, 0.5))
    wing.apply_translation((1.2, 0, 0))
    mast = trimesh.creation.box((0.15, 0.8, 0.15))
    mast.apply_translation((-0.4, 0.7, 0))
    colors = ((200, 170, 90, 255), (60, 70, 110, 255), (190, 190, 190, 255))
    for part, color in zip((body, wing, mast), colors, strict=True):
        part.visual.face_colors = color
    return target_from_scene(trimesh.Scene([body, wing, mast]), "lopsided")


@dataclass
class Scene:
    """Renders frames of the target with whatever surrounds it."""

    target: object
    seed: int = 0

    def __post_init__(self):
        self.renderer = RayRenderer(self.target)
        self._passing = {}
        rng = np.random.default_rng(self.seed)
        ground = np.zeros((512, 512, 3), np.float32)
        for scale, gain in ((8, 40), (32, 25), (128, 12)):
            coarse = rng.normal(size=(scale, scale, 1)) * gain + rng.normal(size=(scale, scale, 3)) * gain / 4
            ground += cv2.resize(coarse.astype(np.float32), (512, 512), interpolation=cv2.INTER_CUBIC)
        self.ground = np.clip(ground + np.array([150, 165, 190]), 90, 255).astype(np.float32)

    def passing(self, i):
        """Frame i of a tumbling pass before moving ground: (pose, picture, truth)."""
        if i not in self._passing:
            T = self.pose(0.05 * i, x=-0.5 + 0.06 * i)
            self._passing[i] = T, self.image(T, ground_shift=2 * i, seed=i), self.truth(T)
        return self._passing[i]

    @staticmethod
    def pose(angle_rad=0.0, x=0.0, y=0.0, z=6.0):
        return lie.transform(lie.so3_exp(np.array([0.5, 0.4 + angle_rad, 0.3])), np.array([x, y, z]))

    def truth(self, T):
        return self.renderer.render(T, CAMERA, color=False).mask

    def image(self, T, ground_shift=None, gain=1.0, noise=2.0, level=0.0, seed=0, stars=0):
        """An antialiased picture: 2 x 2 rays per pixel, a faint lamp, sensor noise, stars one pixel wide."""
        fine = CAMERA.crop(0, 0, WIDTH, HEIGHT, 2.0)
        seen = self.renderer.render(T, fine)
        facing = np.abs(seen.normal_cam[..., 2:])
        lit = seen.rgb.astype(np.float32) * (0.35 + 0.65 * facing) * gain
        if ground_shift is None:
            back = np.full((HEIGHT * 2, WIDTH * 2, 3), level, np.float32)
        else:
            y, x = 40 + ground_shift, 30 + 2 * ground_shift
            back = cv2.resize(self.ground[y : y + HEIGHT, x : x + WIDTH], None, fx=2, fy=2)
        mixed = np.where(seen.mask[..., None], np.maximum(lit, level), back)
        picture = cv2.resize(mixed, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
        rng = np.random.default_rng(seed)
        for _ in range(stars):
            picture[rng.integers(2, HEIGHT - 2), rng.integers(2, WIDTH - 2)] = rng.uniform(60, 255)
        picture += rng.normal(size=(HEIGHT, WIDTH, 1)) * noise
        return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def frame(index, rgb, given_mask=None):
    height, width = rgb.shape[:2]
    return Frame(1_000_000_000 + 100_000_000 * index, rgb, Camera(CAMERA.K, width, height), given_mask)


def prior(T, healthy=True, supported=None):
    row = lie.row_from_matrix(T)
    return PosePrior(1, row, row, healthy, healthy if supported is None else supported)


def overlap(a, b):
    return np.count_nonzero(a & b) / max(1, np.count_nonzero(a | b))
