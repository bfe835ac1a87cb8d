"""Poses, odometry and transforms as messages of ``geometry_msgs`` and ``nav_msgs``."""

from __future__ import annotations

from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.core.initial_pose import InitialPose
from hat_ros.io.message_family import MessageFamily
from hat_ros.types import Motion


class PoseWire(MessageFamily):
    """Encodes poses."""

    def _pose(self, row: Float) -> Any:
        x, y, z, qx, qy, qz, qw = (float(value) for value in row)
        return self._class("geometry_msgs/msg/Pose")(
            position=self._class("geometry_msgs/msg/Point")(x=x, y=y, z=z),
            orientation=self._class("geometry_msgs/msg/Quaternion")(x=qx, y=qy, z=qz, w=qw),
        )

    def pose(self, stamp_ns: int, frame_id: str, pose_row: Float) -> Any:
        """PoseStamped."""
        return self._class("geometry_msgs/msg/PoseStamped")(
            header=self.header(stamp_ns, frame_id), pose=self._pose(pose_row)
        )

    def pose_with_covariance(self, stamp_ns: int, frame_id: str, pose_row: Float, covariance: Float) -> Any:
        """PoseWithCovarianceStamped; both sides order the covariance as translation, then rotation about x, y, z."""
        return self._class("geometry_msgs/msg/PoseWithCovarianceStamped")(
            header=self.header(stamp_ns, frame_id), pose=self._with_covariance(pose_row, covariance)
        )

    def _with_covariance(self, pose_row: Float, covariance: Float) -> Any:
        values = np.asarray(covariance, dtype=np.float64).ravel().copy()
        return self._class("geometry_msgs/msg/PoseWithCovariance")(pose=self._pose(pose_row), covariance=values)

    def pose_array(self, stamp_ns: int, frame_id: str, pose_rows: Float) -> Any:
        """PoseArray, in the order of the rows."""
        return self._class("geometry_msgs/msg/PoseArray")(
            header=self.header(stamp_ns, frame_id), poses=[self._pose(row) for row in pose_rows]
        )

    def odometry(self, stamp_ns: int, camera_frame_id: str, motion: Motion) -> Any:
        """Odometry of the camera in ``slam_<epoch>``, unscaled.

        Only the rotation has a stated uncertainty (``Motion.sigma_rad``); -1 in the first element of a covariance means
        "unknown" by ROS convention, so the translation has a variance of its own gauge: unknown scale, 1e6.
        """
        covariance = np.zeros((6, 6))
        if np.isfinite(motion.sigma_rad):
            np.fill_diagonal(covariance, [1e6] * 3 + [motion.sigma_rad**2] * 3)
        else:
            covariance[0, 0] = -1.0
        vector = self._class("geometry_msgs/msg/Vector3")
        twist = self._class("geometry_msgs/msg/Twist")(
            linear=vector(x=0.0, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0)
        )
        unknown = np.zeros(36)
        unknown[0] = -1.0
        return self._class("nav_msgs/msg/Odometry")(
            header=self.header(stamp_ns, f"slam_{motion.epoch}"),
            child_frame_id=camera_frame_id,
            pose=self._with_covariance(motion.pose_row, covariance),
            twist=self._class("geometry_msgs/msg/TwistWithCovariance")(twist=twist, covariance=unknown),
        )

    def transform(self, stamp_ns: int, frame_id: str, child_frame_id: str, pose_row: Float) -> Any:
        """TransformStamped."""
        x, y, z, qx, qy, qz, qw = (float(value) for value in pose_row)
        return self._class("geometry_msgs/msg/TransformStamped")(
            header=self.header(stamp_ns, frame_id),
            child_frame_id=child_frame_id,
            transform=self._class("geometry_msgs/msg/Transform")(
                translation=self._class("geometry_msgs/msg/Vector3")(x=x, y=y, z=z),
                rotation=self._class("geometry_msgs/msg/Quaternion")(x=qx, y=qy, z=qz, w=qw),
            ),
        )


def pose_row_from(pose: Any) -> Float:
    """(7,) row of a geometry_msgs/Pose, as it stands."""
    p, q = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w], dtype=np.float64)


def initial_pose_from(message: Any) -> InitialPose:
    """Decode a PoseWithCovarianceStamped that says roughly where the target is.

    Raises:
        InputError: it is no possible pose.
    """
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    return InitialPose(pose_row_from(message.pose.pose), covariance)
