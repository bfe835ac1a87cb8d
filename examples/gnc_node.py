"""A GNC node: takes each pose together with its state, and updates a filter only with what is TRACKING.

    python examples/gnc_node.py

The status is a PointCloud2 with one row of named float64 columns, published after the pose of the same stamp.
"""

from __future__ import annotations

import math

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

UNINITIALISED, TRACKING, COASTING, LOST = range(4)
NAMES = {UNINITIALISED: "UNINITIALISED", TRACKING: "TRACKING", COASTING: "COASTING", LOST: "LOST"}


def first_row(table: PointCloud2) -> dict[str, float]:
    """The only row of a table message, by column."""
    values = np.frombuffer(table.data, dtype="<f8", count=len(table.fields))
    return {field.name: float(value) for field, value in zip(table.fields, values, strict=True)}


class GncNode(Node):
    """Joins pose and state by stamp."""

    def __init__(self) -> None:
        super().__init__("gnc")
        self._poses: dict[tuple[int, int], PoseWithCovarianceStamped] = {}
        self.create_subscription(PoseWithCovarianceStamped, "/target_pose_with_covariance", self._on_pose, 10)
        self.create_subscription(PointCloud2, "/hat/status", self._on_status, 10)

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._poses[message.header.stamp.sec, message.header.stamp.nanosec] = message

    def _on_status(self, message: PointCloud2) -> None:
        stamp = message.header.stamp
        state = int(first_row(message)["state"])
        pose = self._poses.pop((stamp.sec, stamp.nanosec), None)
        # Poses of older frames that lack a status are of no use any more.
        self._poses = {key: value for key, value in self._poses.items() if key > (stamp.sec, stamp.nanosec)}
        time = f"{stamp.sec}.{stamp.nanosec // 1_000_000:03d}"
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
    node = GncNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        if rclpy.ok():
            rclpy.shutdown()


if __name__ == "__main__":
    main()
