"""Rendering by ray casting on the CPU: no GL, and the same bytes every time.

One ray through each pixel centre, with camera z = 1, so that the ray parameter of a hit is its depth. Only pixels
within the projected bounds of the convex hull are cast.
"""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Bool, Float, Float32
from hat_ros.target.model import Target
from hat_ros.target.rays import Hits, ray_caster
from hat_ros.target.rendering import Rendering
from hat_ros.target.silhouette import cast_silhouette
from hat_ros.types import Camera


class RayRenderer:
    """See the module's text.

    Attributes:
        caster: of the target.
    """

    def __init__(self, target: Target) -> None:
        self._target = target
        self.caster = ray_caster(target)
        self._face_normals = target.face_normals.astype(np.float32)

    def render(self, T_cam_target: Float, camera: Camera, color: bool = True) -> Rendering:
        """See :meth:`hat_ros.target.rendering.Renderer.render`."""
        shape = (camera.height, camera.width)
        depth = np.zeros(shape, np.float32)
        normal = np.zeros((*shape, 3), np.float32)
        face_id = np.full(shape, -1, np.int32)
        rgb = np.zeros((*shape, 3), np.uint8)
        x0, y0, x1, y1 = self.pixel_bounds(T_cam_target, camera)
        if x0 >= x1 or y0 >= y1:
            return Rendering(depth, normal, face_id, rgb)

        R = T_cam_target[:3, :3]
        directions, hits = self._cast(T_cam_target, camera, (x0, y0, x1, y1))
        face = hits.face
        hit = np.flatnonzero(face >= 0)
        rows, cols = np.divmod(hit, x1 - x0)
        at = (rows + y0) * camera.width + (cols + x0)
        face = face[hit]
        n = self._face_normals[face]
        away = np.einsum("nk,nk->n", n, directions[hit]) > 0
        n[away] *= np.float32(-1)
        depth.reshape(-1)[at] = hits.distance[hit]
        normal.reshape(-1, 3)[at] = n @ R.T.astype(np.float32)
        face_id.reshape(-1)[at] = face
        if color:
            barycentric = hits.taken(hit).barycentric
            rgb.reshape(-1, 3)[at] = self._target.surface.sample(face, barycentric, self._target.face_rgb)
        return Rendering(depth, normal, face_id, rgb)

    def silhouette(self, T_cam_target: Float, camera: Camera) -> Bool:
        """The mask alone, (H, W); cheaper than :meth:`render`."""
        mask = np.zeros((camera.height, camera.width), np.bool_)
        x0, y0, x1, y1 = self.pixel_bounds(T_cam_target, camera)
        if x0 < x1 and y0 < y1:
            _, hits = self._cast(T_cam_target, camera, (x0, y0, x1, y1))
            mask[y0:y1, x0:x1] = (hits.face >= 0).reshape(y1 - y0, x1 - x0)
        return mask

    def quick_silhouette(self, T_cam_target: Float, camera: Camera) -> Bool:
        """The mask like :meth:`silhouette` in half the time; specks may be lost."""
        mask = np.zeros((camera.height, camera.width), np.bool_)
        x0, y0, x1, y1 = self.pixel_bounds(T_cam_target, camera)
        if x0 >= x1 or y0 >= y1:
            return mask
        R, t = T_cam_target[:3, :3], T_cam_target[:3, 3]
        K = camera.K.copy()
        K[:2, 2] -= x0, y0
        to_ray, origin = np.ascontiguousarray((R.T @ np.linalg.inv(K)).T), -t @ R
        width, height = x1 - x0 + (x1 - x0) % 2, y1 - y0 + (y1 - y0) % 2
        part = cast_silhouette(self.caster, width, height, to_ray, origin).mask
        mask[y0:y1, x0:x1] = part[: y1 - y0, : x1 - x0]
        return mask

    def _cast(self, T_cam_target: Float, camera: Camera, bounds: tuple[int, int, int, int]) -> tuple[Float32, Hits]:
        """Directions in the target frame (N, 3), and hits, of the rays through a half-open box of pixels, by rows."""
        R, t = T_cam_target[:3, :3], T_cam_target[:3, 3]
        x0, y0, x1, y1 = bounds
        # Rays in the target frame are affine in (u, v): no per-pixel matrix product.
        to_ray = R.T @ np.linalg.inv(camera.K)
        across = np.arange(x0, x1)[:, None] * to_ray[:, 0]
        down = np.arange(y0, y1)[:, None] * to_ray[:, 1] + to_ray[:, 2]
        directions = np.add(down[:, None], across[None], dtype=np.float32, casting="same_kind").reshape(-1, 3)
        origins = np.empty_like(directions)
        origins[:] = -t @ R
        return directions, self.caster.trace(origins, directions)

    def pixel_bounds(self, T_cam_target: Float, camera: Camera) -> tuple[int, int, int, int]:
        """Half-open pixel range that can see the target: x0, y0, x1, y1."""
        points = self._target.hull_m @ T_cam_target[:3, :3].T + T_cam_target[:3, 3]
        if points[:, 2].max() <= 0:
            return 0, 0, 0, 0
        if points[:, 2].min() <= 1e-6:  # the camera is beside or inside: no finite bounds
            return 0, 0, camera.width, camera.height
        uv = camera.project(points)
        size = np.array([camera.width, camera.height])
        low = np.clip(np.floor(uv.min(axis=0)), 0, size).astype(int)
        high = np.clip(np.ceil(uv.max(axis=0)) + 1, 0, size).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])
