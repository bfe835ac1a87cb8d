"""The README's subscriber is run as it stands there."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseStamped

from hat_ros.io.messages import Wire
from hat_ros.ros.domain import reserved_domain

README = Path(__file__).parents[2] / "README.md"


@pytest.mark.graph
def test_the_ten_line_subscriber_prints_poses(tmp_path):
    script = tmp_path / "gnc.py"
    script.write_text(re.search(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL).group(1))
    with reserved_domain(None) as domain:
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        subscriber = subprocess.Popen(
            [sys.executable, script], env=environment, stdout=subprocess.PIPE, text=True, stderr=subprocess.PIPE
        )
        context = rclpy.Context()
        rclpy.init(args=[], context=context, domain_id=domain)
        try:
            node = rclpy.create_node("source", context=context)
            publisher = node.create_publisher(PoseStamped, "/target_pose", 10)
            message = Wire.ros().pose(5_000_000_000, "camera", np.array([0.1, 0.2, 7.25, 0.0, 0.0, 0.0, 1.0]))
            executor = rclpy.executors.SingleThreadedExecutor(context=context)
            executor.add_node(node)
            for _ in range(600):
                if publisher.get_subscription_count():
                    break
                executor.spin_once(timeout_sec=0.05)
                assert subscriber.poll() is None, subscriber.stderr.read()
            publisher.publish(message)
            line = subscriber.stdout.readline()
        finally:
            subscriber.kill()
            subscriber.communicate()
            rclpy.shutdown(context=context)
    assert "range 7.250 m" in line
