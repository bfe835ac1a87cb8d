"""All message encoding behind one interface: stage types <-> ROS messages, byte for byte, and nothing else.

Everything else in the package asks this module alone, so other message types can take the place of these. The parts:
:mod:`~hat_ros.io.table` and :mod:`~hat_ros.io.stage_tables` (stages), :mod:`~hat_ros.io.image_messages` (frames and
calibration), :mod:`~hat_ros.io.pose_messages`, and :mod:`~hat_ros.io.message_family` (whose message classes).

Decoders take any object with the message's attributes, so they serve rclpy's messages and those that ``rosbags`` reads
alike; neither is imported here. :class:`Wire` encodes into either family.
"""

from __future__ import annotations

from typing import Any

from hat_ros.io.image_messages import ImageWire, camera_from, frame_from
from hat_ros.io.message_family import message_class, stamp_of
from hat_ros.io.pose_messages import PoseWire, initial_pose_from, pose_row_from
from hat_ros.io.stage_tables import (
    Admitted,
    StageWire,
    Status,
    admitted_from,
    alignment_from,
    candidates_from,
    motion_from,
    selection_from,
    status_from,
)
from hat_ros.io.table import read_table

__all__ = [
    "Admitted",
    "Status",
    "Wire",
    "admitted_from",
    "alignment_from",
    "camera_from",
    "candidates_from",
    "frame_from",
    "initial_pose_from",
    "message_class",
    "motion_from",
    "pose_row_from",
    "read_table",
    "selection_from",
    "stamp_of",
    "status_from",
]


class Wire(StageWire, ImageWire, PoseWire):
    """Encodes everything that the graph sends; :meth:`ros` and :meth:`bag` choose the family of messages."""

    def diagnostics(self, stamp_ns: int, name: str, level: int, text: str, values: dict[str, Any]) -> Any:
        """DiagnosticArray with one status; ``level`` is 0 OK, 1 WARN, 2 ERROR, 3 STALE."""
        key_value = self._class("diagnostic_msgs/msg/KeyValue")
        status = self._class("diagnostic_msgs/msg/DiagnosticStatus")(
            level=bytes([level]),
            name=name,
            message=text,
            hardware_id="",
            values=[key_value(key=key, value=str(value)) for key, value in values.items()],
        )
        return self._class("diagnostic_msgs/msg/DiagnosticArray")(header=self.header(stamp_ns, ""), status=[status])
