"""The estimate drawn into the image, for viewers, reports and videos: CAD outline, axes of the target frame, state."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from hat_ros.array_types import Float, UInt8
from hat_ros.geometry import lie
from hat_ros.target.model import Target
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.rendering import Renderer
from hat_ros.types import Camera, TrackState

# RGB.
STATE_RGB = {
    TrackState.UNINITIALISED: (160, 160, 160),
    TrackState.TRACKING: (80, 255, 120),
    TrackState.COASTING: (255, 200, 60),
    TrackState.LOST: (255, 80, 80),
    TrackState.INITIALISING: (215, 150, 255),
}
TRUTH_RGB = (90, 170, 255)
_AXES_RGB = ((255, 70, 70), (70, 255, 70), (90, 130, 255))
# The outline is rendered at most this wide and enlarged: exact enough to look at, and cheap.
_RENDER_SIDE_PX = 320


class OverlayPainter:
    """Draws poses of one target into its images."""

    def __init__(self, target: Target, renderer: Renderer | None = None) -> None:
        self._target = target
        self._renderer = renderer or RayRenderer(target)

    def paint(
        self,
        rgb: UInt8,
        camera: Camera,
        state: TrackState,
        pose_row: Float,
        note: str = "",
        truth_row: Float | None = None,
    ) -> UInt8:
        """A copy of the image with the estimate drawn in.

        Args:
            rgb: (H, W, 3) image.
            camera: its calibration.
            state: colours the outline and is written in the corner.
            pose_row: (7,) ``T_cam_target``; nothing is drawn for NaN.
            note: more text for the corner, e.g. the time.
            truth_row: (7,) true pose, drawn as a thin blue outline.
        """
        canvas = np.ascontiguousarray(rgb).copy()
        if truth_row is not None and np.isfinite(truth_row).all():
            self._outline(canvas, camera, lie.matrix_from_row(truth_row), TRUTH_RGB)
        if np.isfinite(pose_row).all():
            T_cam_target = lie.matrix_from_row(pose_row)
            self._outline(canvas, camera, T_cam_target, STATE_RGB[state])
            self._axes(canvas, camera, T_cam_target)
        self._label(canvas, f"{state.name} {note}".strip(), STATE_RGB[state])
        return canvas

    def _outline(self, canvas: UInt8, camera: Camera, T_cam_target: Float, color: tuple) -> None:
        scale = min(1.0, _RENDER_SIDE_PX / max(camera.width, camera.height))
        small = camera.crop(0, 0, camera.width, camera.height, scale)
        mask = self._renderer.render(T_cam_target, small, color=False).mask.astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        shift = 4  # sixteenths of a pixel
        for contour in contours:
            points = (contour.astype(np.float64) + 0.5) / scale - 0.5
            cv2.polylines(canvas, [np.rint(points * 2**shift).astype(np.int32)], True, color, 1, cv2.LINE_AA, shift)

    def _axes(self, canvas: UInt8, camera: Camera, T_cam_target: Float) -> None:
        length = 0.6 * self._target.bounding_radius_m
        tips = np.vstack([np.zeros(3), length * np.eye(3)])
        points = tips @ T_cam_target[:3, :3].T + T_cam_target[:3, 3]
        if points[:, 2].min() <= 1e-3:
            return
        pixels = np.clip(camera.project(points), -1e4, 1e4)
        order = np.argsort(-points[1:, 2])  # the nearest axis on top
        for axis in order:
            start, end = (tuple(int(v) for v in np.rint(pixels[i])) for i in (0, axis + 1))
            cv2.line(canvas, start, end, _AXES_RGB[axis], 2, cv2.LINE_AA)

    @staticmethod
    def _label(canvas: UInt8, text: str, color: tuple) -> None:
        size = max(0.45, canvas.shape[1] / 1400)
        origin = (int(10 * size) + 4, int(30 * size) + 4)
        for ink, width in (((0, 0, 0), 4), (color, 1)):
            cv2.putText(canvas, text, origin, cv2.FONT_HERSHEY_SIMPLEX, size, ink, width, cv2.LINE_AA)


class VideoFile:
    """A video that grows frame by frame: MP4 where OpenCV can write it, else Motion-JPEG AVI."""

    def __init__(self, stem: Path, width: int, height: int, fps: float) -> None:
        self.path = stem.with_suffix(".mp4")
        self._writer = cv2.VideoWriter(str(self.path), cv2.VideoWriter.fourcc(*"mp4v"), fps, (width, height))
        if not self._writer.isOpened():
            self.path = stem.with_suffix(".avi")
            self._writer = cv2.VideoWriter(str(self.path), cv2.VideoWriter.fourcc(*"MJPG"), fps, (width, height))

    def add(self, rgb: UInt8) -> None:
        """Append a frame of the size given at the start."""
        self._writer.write(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))

    def close(self) -> None:
        """Finish the file."""
        self._writer.release()
