"""A GNC node: takes each pose together with its state, and updates a filter only with what is TRACKING.

    python examples/gnc_node.py

The status is a PointCloud2 with one row of named float64 columns, and the stamp of its pose.
"""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

UNINITIALISED, TRACKING, COASTING, LOST, INITIALISING = range(5)
NAMES = ("UNINITIALISED", "TRACKING", "COASTING", "LOST", "INITIALISING")


def first_row(table: PointCloud2) -> dict[str, float]:
    """The only row of a table message, by column."""
    values = np.frombuffer(table.data, dtype="<f8", count=len(table.fields))
    return {field.name: float(value) for field, value in zip(table.fields, values, strict=True)}


class GncNode(Node):
    """Joins pose and state by stamp."""

    def __init__(self) -> None:
        super().__init__("gnc")
        self._poses: dict[tuple[int, int], PoseWithCovarianceStamped] = {}
        self._states: dict[tuple[int, int], int] = {}
        self.create_subscription(PoseWithCovarianceStamped, "/target_pose_with_covariance", self._on_pose, 10)
        self.create_subscription(PointCloud2, "/hat/status", self._on_status, 10)

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        key = (message.header.stamp.sec, message.header.stamp.nanosec)
        self._poses[key] = message
        self._join(key)

    def _on_status(self, message: PointCloud2) -> None:
        key = (message.header.stamp.sec, message.header.stamp.nanosec)
        self._states[key] = int(first_row(message)["state"])
        self._join(key)

    def _join(self, key: tuple[int, int]) -> None:
        """Act once a frame's state is known, and its pose if it has one: two topics may arrive in either order."""
        state, pose = self._states.get(key), self._poses.get(key)
        if state is None or (pose is None and state in (TRACKING, COASTING)):
            return
        for waiting in (self._states, self._poses):
            for old in [other for other in waiting if other <= key]:
                del waiting[old]
        time = f"{key[0]}.{key[1] // 1_000_000:03d}"
        if pose is None:
            print(f"{time} {NAMES[state]}: no pose, hold", flush=True)
        elif state == TRACKING:
            self.update_filter(time, pose)
        else:
            print(f"{time} {NAMES[state]}: propagate", flush=True)

    def update_filter(self, time: str, message: PoseWithCovarianceStamped) -> None:
        """Where the filter goes. The covariance: camera axes, translation (m^2) before rotation vector (rad^2)."""
        p, q = message.pose.pose.position, message.pose.pose.orientation
        covariance = np.asarray(message.pose.covariance).reshape(6, 6)
        sigma_range_m = math.sqrt(covariance[2, 2])
        attitude = f"q_xyzw {q.x:+.4f} {q.y:+.4f} {q.z:+.4f} {q.w:+.4f}"
        print(f"{time} TRACKING: range {p.z:.3f} m +- {sigma_range_m:.3f}, {attitude}", flush=True)


def main() -> None:
    """Run until interrupted."""
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(GncNode())


if __name__ == "__main__":
    main()
