"""The picture of ``hat check``: a CAD model from six sides with its axes and a scale bar, and frames of a recording."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from hat_ros.array_types import Float, UInt8
from hat_ros.geometry import lie
from hat_ros.target.model import Target
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.types import Camera

TILE_PX = 320
_DISTANCE_RADII = 20.0
_FILL = 0.42
_SKY = 40
# Side that faces the camera -> rows of R_cam_target: image right, image down, away from the camera.
_SIDES = {
    "+x": ((0, 1, 0), (0, 0, -1), (-1, 0, 0)),
    "+y": ((-1, 0, 0), (0, 0, -1), (0, -1, 0)),
    "+z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "-x": ((0, -1, 0), (0, 0, -1), (1, 0, 0)),
    "-y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-z": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
}
_AXIS_RGB = {"x": (255, 70, 70), "y": (70, 255, 70), "z": (110, 140, 255)}


def picture(target: Target, frames: Sequence[UInt8] = ()) -> UInt8:
    """(H, W, 3) uint8 RGB: two rows of three sides, and a row of at most three frames, fitted into their tiles."""
    renderer = RayRenderer(target)
    tiles = [_side(target, renderer, name, np.array(rows, dtype=np.float64)) for name, rows in _SIDES.items()]
    if frames:
        fitted = [_fitted(frame) for frame in frames[:3]]
        tiles += fitted + [np.zeros_like(tiles[0])] * (3 - len(fitted))
    return np.vstack([np.hstack(tiles[i : i + 3]) for i in range(0, len(tiles), 3)])


def _side(target: Target, renderer: RayRenderer, name: str, R: Float) -> UInt8:
    radius, middle = target.bounding_radius_m, (TILE_PX - 1) / 2
    px_per_m = _FILL * TILE_PX / radius
    focal = px_per_m * _DISTANCE_RADII * radius
    camera = Camera(np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]]), TILE_PX, TILE_PX)
    T = lie.transform(R, np.array([0, 0, _DISTANCE_RADII * radius]) - R @ target.center_m)
    rendering = renderer.render(T, camera)
    light = 0.3 + 0.7 * np.abs(rendering.normal_cam[..., 2:])
    shaded = np.where(rendering.face_id[..., None] >= 0, rendering.rgb * light, _SKY)
    tile = np.ascontiguousarray(shaded.astype(np.uint8))
    _draw_axes(tile, camera, T, 0.6 * radius)
    _write(tile, f"from {name}", (8, 20), (255, 255, 255))
    bar_m = _round_length(0.8 * radius)
    start, end = (8, TILE_PX - 10), (8 + round(bar_m * px_per_m), TILE_PX - 10)
    cv2.line(tile, start, end, (255, 255, 255), 2)
    _write(tile, f"{bar_m:g} m", (8, TILE_PX - 18), (255, 255, 255))
    return tile


def _draw_axes(tile: UInt8, camera: Camera, T_cam_target: Float, length_m: float) -> None:
    """Arrows from the origin of the file along its axes; those along the line of sight are left out."""
    ends = np.vstack([np.zeros(3), length_m * np.eye(3)]) @ T_cam_target[:3, :3].T + T_cam_target[:3, 3]
    if (ends[:, 2] <= 0).any():
        return
    origin, *tips = np.rint(np.clip(camera.project(ends), -1e4, 1e4)).astype(int).tolist()
    for (axis, color), tip in zip(_AXIS_RGB.items(), tips, strict=True):
        if np.hypot(tip[0] - origin[0], tip[1] - origin[1]) > TILE_PX / 20:
            cv2.arrowedLine(tile, origin, tip, color, 2, cv2.LINE_AA, tipLength=0.12)
            _write(tile, axis, (tip[0] + 4, tip[1] - 4), color)


def _write(tile: UInt8, text: str, at: tuple[int, int], color: tuple[int, int, int]) -> None:
    cv2.putText(tile, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, 1, cv2.LINE_AA)


def _round_length(limit_m: float) -> float:
    """The largest of 1, 2, 5 times a power of ten up to a limit."""
    power = 10.0 ** np.floor(np.log10(limit_m))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= limit_m * (1 + 1e-9)))


def _fitted(frame: UInt8) -> UInt8:
    height, width = frame.shape[:2]
    scale = TILE_PX / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    tile = np.zeros((TILE_PX, TILE_PX, 3), np.uint8)
    top, left = (TILE_PX - size[1]) // 2, (TILE_PX - size[0]) // 2
    tile[top : top + size[1], left : left + size[0]] = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
    return tile
