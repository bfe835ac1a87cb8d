"""The state that a node reports in ``/diagnostics``: once a second, and at once when it changes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from hat_ros.io import topics
from hat_ros.io.messages import Wire, message_class
from hat_ros.ros import qos

OK, WARN, ERROR, STALE = 0, 1, 2, 3
# Begins what a node reports while it works on something that takes long, so that it is not given up meanwhile.
BUSY = "busy: "
STEADY = Clock(clock_type=ClockType.STEADY_TIME)


def prefix_of(node: Node) -> str:
    """What the names in ``/diagnostics`` begin with: ``hat: ``, and the namespace where there is one."""
    namespace = node.get_namespace().strip("/")
    return f"hat: {namespace}/" if namespace else "hat: "


class Diagnostics:
    """The reported state of one node.

    Args:
        node: the node.
        name: what it is called, behind its namespace.
        wire: encodes messages.
        values: gives the figures that go with the text.

    Attributes:
        level: 0 OK, 1 WARN, 2 ERROR, 3 STALE.
        text: one sentence.
    """

    def __init__(self, node: Node, name: str, wire: Wire, values: Callable[[], dict[str, Any]]) -> None:
        self._name = f"{prefix_of(node)}{name}"
        self._log = node.get_logger()
        self._clock = node.get_clock()
        self._wire, self._values = wire, values
        self.level, self.text = OK, "unconfigured"
        self._publisher = node.create_publisher(
            message_class(topics.TYPES[topics.DIAGNOSTICS]), topics.DIAGNOSTICS, qos.OUT
        )

    def report(self, level: int, text: str) -> None:
        """Set the state; published at once when it changes."""
        if (level, text) != (self.level, self.text):
            self.level, self.text = level, text
            self.publish()

    def publish(self) -> None:
        """Send the state as it is, with the figures of now."""
        stamp_ns = self._clock.now().nanoseconds  # of /clock, with use_sim_time
        message = self._wire.diagnostics(stamp_ns, self._name, self.level, self.text, self._values())
        self._publisher.publish(message)

    def wait_for_readers(self, timeout_s: float) -> None:
        """Wait until every matched reader has what was published."""
        self._publisher.wait_for_all_acked(Duration(seconds=timeout_s))

    @contextmanager
    def relayed_log(self) -> Iterator[None]:
        """What the package logs inside goes into the node's log and its diagnostics; then the state is as before."""
        before, handler, log = (self.level, self.text), _Relay(self._relay), logging.getLogger("hat_ros")
        log.addHandler(handler)
        try:
            yield
        finally:
            log.removeHandler(handler)
            if self.text.startswith(BUSY):
                self.report(*before)

    def _relay(self, text: str) -> None:
        self._log.info(text)
        self.report(OK, f"{BUSY}{text}")


class _Relay(logging.Handler):
    """Hands on the text of each record."""

    def __init__(self, relay: Callable[[str], None]) -> None:
        super().__init__(logging.INFO)
        self._relay = relay

    def emit(self, record: logging.LogRecord) -> None:
        self._relay(record.getMessage())
