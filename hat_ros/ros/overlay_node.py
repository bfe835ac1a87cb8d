"""Debug overlay: CAD outline, axes and state drawn into the image, only while it is watched.

Without a subscriber to ``/hat/overlay/compressed`` not even the images are received.
"""

from __future__ import annotations

import sys
from typing import Any, ClassVar

import numpy as np

from hat_ros.app.overlay import OverlayPainter
from hat_ros.io import messages, topics
from hat_ros.io.images import encode_image
from hat_ros.ros import process, qos
from hat_ros.ros.node import HatNode
from hat_ros.ros.session import Session
from hat_ros.types import Camera

# Images that may wait for their status; more than the frames in flight.
_FRAMES_KEPT = 32


class OverlaySession(Session):
    """Draws each estimate into its own image, found by exact stamp."""

    def __init__(self, node: HatNode[Session]) -> None:
        self._painter = OverlayPainter(node.settings.load_target())
        self._quality: int = node.settings.extra["jpeg_quality"]
        self._wire, self._endpoints = node.wire, node.endpoints
        self._camera: Camera | None = None
        self._frames: dict[int, Any] = {}
        self._drawn = node.endpoints.output(topics.OVERLAY)
        node.endpoints.input(topics.HAT_CAMERA_INFO, self._on_camera_info, required=False)
        node.endpoints.input(topics.STATUS, self._on_status, required=False)

    def every_second(self) -> None:
        """Receive images only while the overlay is watched."""
        watched = self._drawn.get_subscription_count() > 0
        if watched and not self._endpoints.has_input(topics.FRAME):
            self._endpoints.input(topics.FRAME, self._on_frame, profile=qos.STAGE, required=False)
        elif not watched and self._endpoints.has_input(topics.FRAME):
            self._endpoints.drop_input(topics.FRAME)
            self._frames.clear()

    def _on_camera_info(self, message: Any) -> None:
        self._camera = messages.camera_from(message)

    def _on_frame(self, message: Any) -> None:
        stamp_ns = messages.stamp_of(message)
        self._frames.pop(stamp_ns, None)
        self._frames[stamp_ns] = message
        if len(self._frames) > _FRAMES_KEPT:
            del self._frames[next(iter(self._frames))]  # the one that came first: stamps may begin anew

    def _on_status(self, message: Any) -> None:
        estimate = messages.status_from(message).estimate
        frame = self._frames.pop(estimate.stamp_ns, None)
        if frame is None or self._camera is None:
            return
        rgb, _ = messages.frame_from(frame)
        pose_row = estimate.pose_row if estimate.state.has_pose else np.full(7, np.nan)
        image = self._painter.paint(rgb, self._camera, estimate.state, pose_row)
        data = encode_image(image, "jpeg", self._quality)
        self._drawn.publish(self._wire.compressed(estimate.stamp_ns, frame.header.frame_id, "jpeg", data))


class OverlayNode(HatNode[OverlaySession]):
    """The node of the overlay."""

    NAME = "overlay"
    EXTRA_PARAMETERS: ClassVar = {"jpeg_quality": (80, "quality of the published JPEG, 1 to 100")}

    def open_session(self) -> OverlaySession:
        """Build the painter and its endpoints."""
        return OverlaySession(self)


def main() -> int:
    """Console script."""
    return process.main([OverlayNode])


if __name__ == "__main__":
    sys.exit(main())
