"""Debug overlay: CAD outline, axes and state drawn into the image, only while somebody looks.

Without a subscriber to ``/hat/overlay/compressed`` not even the images are received.
"""

from __future__ import annotations

import sys
from typing import Any, ClassVar

import cv2
import numpy as np

from hat_ros.app.overlay import OverlayPainter
from hat_ros.io import messages, topics
from hat_ros.ros import base, process, qos
from hat_ros.types import Camera

# Images that may wait for their status; more than the frames in flight.
_FRAMES_KEPT = 32


class OverlayNode(base.HatNode):
    """Draws each estimate into its own image, found by exact stamp."""

    NAME = "overlay"
    EXTRA_PARAMETERS: ClassVar = {"jpeg_quality": (80, "quality of the published JPEG, 1 to 100")}

    def configure(self) -> None:
        """Build the painter and its endpoints."""
        self._painter = OverlayPainter(self.settings.load_target())
        self._camera: Camera | None = None
        self._frames: dict[int, Any] = {}
        self._drawn = self.output(topics.OVERLAY)
        self.input(topics.HAT_CAMERA_INFO, self._on_camera_info, required=False)
        self.input(topics.STATUS, self._on_status, required=False)

    def cleanup(self) -> None:
        """Drop the painter."""
        del self._painter
        self._frames.clear()

    def every_second(self) -> None:
        """Receive images only while somebody looks."""
        watched = self._drawn.get_subscription_count() > 0
        if watched and not self.has_input(topics.FRAME):
            self.input(topics.FRAME, self._on_frame, profile=qos.STAGE, required=False)
        elif not watched and self.has_input(topics.FRAME):
            self.drop_input(topics.FRAME)
            self._frames.clear()

    def _on_camera_info(self, message: Any) -> None:
        self._camera = messages.camera_from(message)

    def _on_frame(self, message: Any) -> None:
        self._frames[messages.stamp_of(message)] = message
        while len(self._frames) > _FRAMES_KEPT:
            del self._frames[min(self._frames)]

    def _on_status(self, message: Any) -> None:
        estimate = messages.status_from(message).estimate
        frame = self._frames.pop(estimate.stamp_ns, None)
        if frame is None or self._camera is None:
            return
        rgb, _ = messages.frame_from(frame)
        pose_row = estimate.pose_row if estimate.state.has_pose else np.full(7, np.nan)
        image = self._painter.paint(rgb, self._camera, estimate.state, pose_row)
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.settings.extra["jpeg_quality"]]
        data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), quality)[1].tobytes()
        self._drawn.publish(self.wire.compressed(estimate.stamp_ns, frame.header.frame_id, "jpeg", data))


def main() -> int:
    """Console script."""
    return process.main([OverlayNode])


if __name__ == "__main__":
    sys.exit(main())
