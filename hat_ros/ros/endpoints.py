"""The publishers and subscriptions of a node, and whether they are matched with their counterparts."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import DurabilityPolicy, QoSProfile

from hat_ros.io import topics
from hat_ros.io.messages import message_class
from hat_ros.ros import qos

# Begins the names of our nodes.
PREFIX = "hat_"
# Each event is an entity more in every wait; between our own nodes readiness already tells what does not fit.
_NO_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)
# Latched messages that are kept for a node which is not active yet: as many as its readers' queues hold.
_HELD = 16
_NO_PUBLISHER_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)


class Endpoints:
    """What a node sends and receives from configure to cleanup.

    Args:
        node: their node.
        live: chooses the QoS of the camera's topics.
        recorded: a recorder must be matched, too.
        guarded: runs a callback on a message: while the node is active, with its errors caught.
        is_active: whether the node is.
    """

    def __init__(
        self,
        node: LifecycleNode,
        live: bool,
        recorded: bool,
        guarded: Callable[..., None],
        is_active: Callable[[], bool],
    ) -> None:
        self._node, self._live, self._recorded, self._guarded = node, live, recorded, guarded
        self._is_active = is_active
        self._outputs: dict[str, tuple[Any, tuple[str, ...]]] = {}
        self._inputs: dict[str, Any] = {}
        self._required: set[str] = set()
        self._held: deque[tuple[Callable[..., None], Any]] = deque(maxlen=_HELD)

    def output(self, topic: str, *readers: str, profile: QoSProfile | None = None) -> Any:
        """A publisher that is ready once the named nodes (and the recorder, if there is one) have been matched."""
        if self._recorded and topic in topics.RECORDED:
            readers = (*readers, "recorder")
        publisher = self._node.create_lifecycle_publisher(
            message_class(topics.TYPES[topic]),
            topics.relative(topic),
            profile or qos.profile_of(topic, self._live),
            event_callbacks=_NO_PUBLISHER_EVENTS,
        )
        self._outputs[topic] = (publisher, readers)
        return publisher

    def input(
        self,
        topic: str,
        callback: Callable[..., None],
        *,
        profile: QoSProfile | None = None,
        required: bool = True,
        raw: bool = False,
        with_info: bool = False,
    ) -> None:
        """Subscribe; the node is ready once a publisher is matched, unless the input is not required.

        Latched messages come once, perhaps before the node is active; they are kept until it is.

        Args:
            topic: the topic.
            callback: called with each message while the node is active.
            profile: QoS, by default that of the topic's publisher.
            required: the node is not ready without a publisher.
            raw: the callback gets serialized messages.
            with_info: the callback gets the middleware's message info as its second argument.
        """

        profile = profile or qos.profile_of(topic, self._live)
        latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL

        # rclpy looks at the signature to decide whether a callback wants the message's info.
        def receive(message: Any) -> None:
            if latched and not self._is_active():
                self._held.append((callback, message))
            self._guarded(callback, message)

        def receive_with_info(message: Any, info: dict[str, Any]) -> None:
            self._guarded(callback, message, info)

        receiver: Callable[..., None] = receive_with_info if with_info else receive
        self._inputs[topic] = self._node.create_subscription(
            message_class(topics.TYPES[topic]),
            topics.relative(topic),
            receiver,
            profile,
            event_callbacks=_NO_EVENTS if required else None,
            raw=raw,
        )
        if required:
            self._required.add(topic)

    def deliver_held(self) -> None:
        """Take the latched messages that came before the node was active."""
        while self._held:
            self._guarded(*self._held.popleft())

    def has_input(self, topic: str) -> bool:
        """Whether the topic is subscribed."""
        return topic in self._inputs

    def drop_input(self, topic: str) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._inputs.pop(topic))
        self._required.discard(topic)

    def unmatched(self) -> list[str]:
        """Endpoints that do not know their counterparts yet; with none, nothing sent from now on is lost."""
        unheard = [f"a publisher of {t}" for t in sorted(self._required) if not self._inputs[t].get_publisher_count()]
        return unheard + [reader for topic in self._outputs for reader in self._missing_readers(topic)]

    def gone(self, topic: str) -> list[str]:
        """Names of the nodes that should read an output and are not to be seen."""
        names, found = self._outputs[topic][1], self._readers(topic)
        return [name for name in names if name not in found]

    def _readers(self, topic: str) -> list[str]:
        latched = qos.is_latched(topic)
        return [
            info.node_name.removeprefix(PREFIX)
            for info in self._node.get_subscriptions_info_by_topic(topics.relative(topic))
            # A reader that asks for latched messages where there are none is never matched.
            if latched or info.qos_profile.durability != DurabilityPolicy.TRANSIENT_LOCAL
        ]

    def _missing_readers(self, topic: str) -> list[str]:
        publisher, names = self._outputs[topic]
        if not names:
            return []
        found = self._readers(topic)
        missing = [f"{name} on {topic}" for name in names if name not in found]
        # Discovered is not yet matched: only a matched reader gets what is sent next.
        return missing or ([f"readers of {topic}"] if publisher.get_subscription_count() < len(found) else [])

    def unacknowledged(self, timeout_s: float) -> list[str]:
        """Topics of which some matched reader does not acknowledge everything that was sent."""
        limit = Duration(seconds=timeout_s)
        return [topic for topic, (publisher, _) in self._outputs.items() if not publisher.wait_for_all_acked(limit)]

    def clear(self) -> None:
        """Destroy all of them."""
        for subscription in self._inputs.values():
            self._node.destroy_subscription(subscription)
        for publisher, _ in self._outputs.values():
            self._node.destroy_lifecycle_publisher(publisher)
        self._held.clear()
        self._inputs.clear()
        self._outputs.clear()
        self._required.clear()
