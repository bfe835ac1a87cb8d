"""The subscriptions of a camera: to one of the topics that it may use, with the reliability that it offers.

Both are looked up from what is published. A subscription made before its camera would have to guess: a reliable one
never hears a best-effort camera, and one to every transport makes a driver compress images without a reader.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from hat_ros.io.topics import relative
from hat_ros.ros import qos
from hat_ros.ros.endpoints import Endpoints


class CameraInput:
    """Follows the publishers of a camera's topic.

    Args:
        node: the node.
        endpoints: where it subscribes.
        topics: the topics that may carry the messages, the preferred one first.
        live: whether the camera's QoS decides; a replay has a player of our own.
        callback: called with topic, message and the middleware's message info.

    Attributes:
        topic: the one that is subscribed, None before there is a publisher.
    """

    def __init__(
        self,
        node: Node,
        endpoints: Endpoints,
        topics: Sequence[str],
        live: bool,
        callback: Callable[[str, Any, dict[str, Any]], None],
    ) -> None:
        self._node, self._endpoints, self._live, self._callback = node, endpoints, live, callback
        self._topics = tuple(topics)
        self._profile: QoSProfile | None = None
        self.topic: str | None = None

    def follow(self) -> list[str]:
        """Subscribe to what is published now; full names of the nodes that publish it."""
        offers = {topic: self._node.get_publishers_info_by_topic(relative(topic)) for topic in self._topics}
        topic = next((topic for topic in self._topics if offers[topic]), None)
        if self.topic is not None and (offers[self.topic] or topic is None):
            topic = self.topic  # chosen once, as long as somebody sends there
        if topic is None:
            return []
        if offers[topic]:
            reliability = {offer.qos_profile.reliability for offer in offers[topic]}
            profile = qos.camera_profile(self._live, ReliabilityPolicy.BEST_EFFORT in reliability)
            if (topic, profile) != (self.topic, self._profile):
                self._subscribe(topic, profile)
        return sorted(f"{offer.node_namespace.rstrip('/')}/{offer.node_name}" for offer in offers[topic])

    def _subscribe(self, topic: str, profile: QoSProfile) -> None:
        if self.topic is not None:
            self._endpoints.drop_input(self.topic)

        def receive(message: Any, info: dict[str, Any]) -> None:
            self._callback(topic, message, info)

        self._endpoints.input(topic, receive, profile=profile, required=False, with_info=True)
        self.topic, self._profile = topic, profile

    def describe(self) -> str:
        """The topics, as people know them."""
        topics = self._topics if self.topic is None else (self.topic,)
        return " or ".join(self._node.resolve_topic_name(relative(topic)) for topic in topics)
