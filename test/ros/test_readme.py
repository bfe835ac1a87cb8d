"""The README's subscriber is run as it stands there."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import PointCloud2

from hat_ros.io.messages import Admitted, Wire
from hat_ros.ros.domain import reserved_domain
from hat_ros.types import Estimate, TrackState

ROOT = Path(__file__).parents[2]
STAMP_NS, ROW = 5_000_000_000, np.array([0.1, 0.2, 7.25, 0.0, 0.0, 0.0, 1.0])


def readme_script() -> str:
    """The first block of Python that spins."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    return next(block for block in blocks if "rclpy.spin" in block)


def lines_of(script: Path, n: int, with_poses: bool = False) -> list[str]:
    """What a subscriber prints about two frames, one with a pose; it may want that as a message of its own too."""
    with reserved_domain(None) as domain:
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        subscriber = subprocess.Popen(
            [sys.executable, script], env=environment, stdout=subprocess.PIPE, text=True, stderr=subprocess.PIPE
        )
        context = rclpy.Context()
        rclpy.init(args=[], context=context, domain_id=domain)
        try:
            node = rclpy.create_node("source", context=context)
            poses = node.create_publisher(PoseWithCovarianceStamped, "/target_pose_with_covariance", 10)
            statuses = node.create_publisher(PointCloud2, "/hat/status", 10)
            wire, covariance = Wire.ros(), np.diag([1e-4, 1e-4, 4e-4, 1e-5, 1e-5, 1e-5])
            executor = rclpy.executors.SingleThreadedExecutor(context=context)
            executor.add_node(node)
            for _ in range(600):
                if statuses.get_subscription_count() and (poses.get_subscription_count() or not with_poses):
                    break
                executor.spin_once(timeout_sec=0.05)
                assert subscriber.poll() is None, subscriber.stderr.read()
            poses.publish(wire.pose_with_covariance(STAMP_NS, "camera", ROW, covariance))
            for _ in range(10):
                executor.spin_once(timeout_sec=0.05)
            for stamp_ns, state, row in (
                (STAMP_NS, TrackState.TRACKING, ROW),
                (STAMP_NS + 1, TrackState.LOST, np.full(7, np.nan)),
            ):
                estimate = Estimate(stamp_ns, state, row, covariance)
                statuses.publish(wire.status("camera", estimate, Admitted(0, 0, 0)))
            return [subscriber.stdout.readline() for _ in range(n)]
        finally:
            subscriber.kill()
            subscriber.communicate()
            rclpy.shutdown(context=context)


@pytest.mark.graph
def test_the_short_subscriber_prints_state_and_pose(tmp_path):
    script = tmp_path / "gnc.py"
    script.write_text(readme_script(), encoding="utf-8")
    tracking, lost = lines_of(script, 2)
    assert tracking == "TRACKING x +0.100 y +0.200 z +7.250 qx +0.000 qy +0.000 qz +0.000 qw +1.000\n"
    assert lost.startswith("LOST x +nan")


@pytest.mark.graph
def test_the_example_node_joins_pose_and_state():
    tracking, lost = lines_of(ROOT / "examples" / "gnc_node.py", 2, with_poses=True)
    assert "TRACKING: range 7.250 m +- 0.020" in tracking
    assert "LOST: no pose, hold" in lost
