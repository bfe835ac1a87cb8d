"""Does a message get through on this machine? Exit code 0 if so; what `hat doctor` runs in a process of its own."""

from __future__ import annotations

import sys
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Header

_TOPIC = "hat_doctor"
_WAIT_S = 8.0


def main() -> int:
    """Publish to oneself until the first message arrives: what a blocked loopback or shared memory cannot do."""
    rclpy.init()
    node = rclpy.create_node("hat_doctor")
    try:
        received: list[Header] = []
        node.create_subscription(Header, _TOPIC, received.append, 10)
        publisher = node.create_publisher(Header, _TOPIC, 10)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        end = time.monotonic() + _WAIT_S
        while not received and time.monotonic() < end:
            publisher.publish(Header(frame_id="x"))
            executor.spin_once(timeout_sec=0.1)
    finally:
        node.destroy_node()
        rclpy.shutdown()
    return 0 if received else 1


if __name__ == "__main__":
    sys.exit(main())
