"""What all nodes share: lifecycle, parameters, endpoints that know whether they are matched, diagnostics, the end.

rclpy swallows exceptions of lifecycle callbacks and stops an executor on those of others, so both are caught here,
once: a node that fails says so in one sentence, in ``/diagnostics`` and on stderr, and the process ends in a replay.
"""

from __future__ import annotations

import logging
import os
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, ClassVar

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile

from hat_ros.config import GraphConfig
from hat_ros.errors import HatError, RunError
from hat_ros.io import topics
from hat_ros.io.messages import Wire, message_class
from hat_ros.ros import qos
from hat_ros.ros.params import declare_parameters

OK, WARN, ERROR = 0, 1, 2
# Ends the sentence of a stage timeout, so that whoever started the node can tell it from other failures.
HANGS = "a stage does not answer"
# Begins what a node says while it works on something that takes long, so that nobody takes it for dead.
BUSY = "busy: "
_ACK_TIMEOUT_S = 10.0
# Each event is an entity more in every wait; between our own nodes readiness already says what does not fit.
_NO_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)
_NO_PUBLISHER_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)
STEADY = Clock(clock_type=ClockType.STEADY_TIME)


def answer_limit(config: GraphConfig, first: bool) -> tuple[float, str]:
    """How long a frame may take through the graph, and the option to raise; the first one also compiles code."""
    if first and config.startup_timeout_s > config.stage_timeout_s:
        return config.startup_timeout_s, "graph.startup_timeout_s"
    return config.stage_timeout_s, "graph.stage_timeout_s"


class _Busy(logging.Handler):
    """What the algorithms log while a node runs them: into the node's log and its diagnostics."""

    def __init__(self, node: HatNode) -> None:
        super().__init__(logging.INFO)
        self._node = node

    def emit(self, record: logging.LogRecord) -> None:
        self._node.get_logger().info(record.getMessage())
        self._node.report(OK, f"{BUSY}{record.getMessage()}")


class HatNode(LifecycleNode, ABC):
    """A lifecycle node in ``/hat``. Subclasses build themselves in :meth:`configure` and take apart in :meth:`cleanup`.

    Attributes:
        settings: the values of all parameters.
        wire: encodes messages.
        active: the lifecycle state is active; messages that arrive otherwise are dropped.
        failure: what stopped the node, None while all is well.
        finished: the stream ended and everything sent was acknowledged.
    """

    NAME: ClassVar[str]
    EXTRA_PARAMETERS: ClassVar[dict[str, tuple[Any, str]]] = {}
    GOES_ON_LIVE: ClassVar[bool] = True

    def __init__(self, *, context: rclpy.Context | None = None, parameters: dict[str, Any] | None = None) -> None:
        super().__init__(
            self.NAME,
            namespace="/hat",
            context=context,
            parameter_overrides=[Parameter(name, value=value) for name, value in (parameters or {}).items()],
            automatically_declare_parameters_from_overrides=True,
        )
        self.settings = declare_parameters(self, self.EXTRA_PARAMETERS)
        self.wire = Wire.ros()
        self.active = self.finished = False
        self.failure: HatError | None = None
        self._outputs: dict[str, tuple[Any, tuple[str, ...]]] = {}
        self._inputs: dict[str, Any] = {}
        self._required: set[str] = set()
        self._announced = False
        self._level, self._text = OK, "unconfigured"
        self._ready = self.create_publisher(message_class(topics.TYPES[topics.READY]), topics.READY, qos.LATCH)
        self._diagnostics = self.create_publisher(
            message_class(topics.TYPES[topics.DIAGNOSTICS]), topics.DIAGNOSTICS, qos.OUT
        )
        self.create_timer(1.0, self._every_second, clock=STEADY)
        self._announcer = self.create_timer(0.02, self._announce, clock=STEADY)

    # ------------------------------------------------------------ for subclasses

    @abstractmethod
    def configure(self) -> None:
        """Build what the node owns and create its endpoints."""

    def cleanup(self) -> None:
        """Drop what :meth:`configure` built; endpoints go by themselves."""

    def release(self) -> None:
        """Close what outlives the process (files); may be called more than once."""

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics."""
        return {}

    def every_second(self) -> None:
        """Called once a second while active."""

    def output(self, topic: str, *readers: str) -> Any:
        """A publisher that is ready once the named nodes (and the recorder, if there is one) have been matched."""
        if self.settings.recorded and topic in topics.RECORDED:
            readers = (*readers, "recorder")
        profile = qos.profile_of(topic, self.settings.live)
        publisher = self.create_lifecycle_publisher(
            message_class(topics.TYPES[topic]), topic, profile, event_callbacks=_NO_PUBLISHER_EVENTS
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
        """Subscribe; the node is ready once a publisher is matched, unless the input is not required."""
        # rclpy looks at the signature to decide whether a callback wants the message's info.
        plain, informed = (lambda message: guarded(message)), (lambda message, info: guarded(message, info))
        guarded = partial(self.guarded, callback)
        self._inputs[topic] = self.create_subscription(
            message_class(topics.TYPES[topic]),
            topic,
            informed if with_info else plain,
            profile or qos.profile_of(topic, self.settings.live),
            event_callbacks=_NO_EVENTS if required else None,
            raw=raw,
        )
        if required:
            self._required.add(topic)

    def has_input(self, topic: str) -> bool:
        """Whether the topic is subscribed."""
        return topic in self._inputs

    def drop_input(self, topic: str) -> None:
        """Unsubscribe."""
        self.destroy_subscription(self._inputs.pop(topic))
        self._required.discard(topic)

    def guarded(self, callback: Callable[..., None], *args: Any) -> None:
        """Run a callback while active; an exception becomes a failure with one sentence."""
        if not self.active:
            return
        try:
            with self._heard():
                callback(*args)
        except HatError as error:
            self.fail(error)
        except Exception as error:
            self.get_logger().error(traceback.format_exc())
            self.fail(RunError(f"{type(error).__name__}: {error}"))

    @contextmanager
    def _heard(self) -> Iterator[None]:
        """What is logged inside is reported as it comes; then the node says again what it said before."""
        before, handler, log = (self._level, self._text), _Busy(self), logging.getLogger("hat_ros")
        log.addHandler(handler)
        try:
            yield
        finally:
            log.removeHandler(handler)
            if self._text.startswith(BUSY):
                self.report(*before)

    def fail(self, error: HatError) -> None:
        """Say what went wrong; a replay ends, a live graph goes on (its next epoch starts without this frame)."""
        self.get_logger().error(str(error))
        self.report(ERROR, str(error))
        if not (self.settings.live and self.active and self.GOES_ON_LIVE):
            self.failure = error

    def report(self, level: int, text: str) -> None:
        """Set the state shown in diagnostics; published at once when it changes."""
        if (level, text) != (self._level, self._text):
            self._level, self._text = level, text
            self._publish_diagnostics()

    # ------------------------------------------------------------ readiness

    def unmatched(self) -> list[str]:
        """Endpoints that do not know their counterparts yet; with none, nothing sent from now on is lost."""
        silent = [f"a publisher of {t}" for t in sorted(self._required) if not self._inputs[t].get_publisher_count()]
        return silent + [reader for topic in self._outputs for reader in self._missing_readers(topic)]

    def _missing_readers(self, topic: str) -> list[str]:
        publisher, names = self._outputs[topic]
        if not names:
            return []
        latched = qos.is_latched(topic)
        found = [
            info.node_name
            for info in self.get_subscriptions_info_by_topic(topic)
            # A reader that asks for latched messages where there are none is never matched.
            if latched or info.qos_profile.durability != DurabilityPolicy.TRANSIENT_LOCAL
        ]
        missing = [f"{name} on {topic}" for name in names if name not in found]
        # Discovered is not yet matched: only a matched reader gets what is sent next.
        return missing or ([f"readers of {topic}"] if publisher.get_subscription_count() < len(found) else [])

    def _announce(self) -> None:
        if not self.active or self._announced:
            return
        unmatched = self.unmatched()
        if not unmatched:
            self._announced = True
            self._announcer.cancel()
            self._ready.publish(self.wire.header(time.time_ns(), self.NAME))
        self.report(OK, "ready" if not unmatched else f"waiting for {', '.join(unmatched)}")

    # ------------------------------------------------------------ diagnostics, end

    def _every_second(self) -> None:
        supervisor = self.settings.supervisor_pid
        if supervisor and os.getppid() != supervisor:
            self.failure = RunError(f"process {supervisor}, which had started this node, is gone")
        if self.active:
            self.guarded(self.every_second)
        self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        name = f"hat: {self.NAME}"
        message = self.wire.diagnostics(time.time_ns(), name, self._level, self._text, self.values())
        self._diagnostics.publish(message)

    def _on_end_of_stream(self, message: Any) -> None:
        """The last status is out: make sure that everything sent has arrived."""
        stuck = [topic for topic in self._outputs if not self._acknowledged(topic)]
        if stuck:
            self.fail(RunError(f"not acknowledged by all readers at the end of the stream: {', '.join(stuck)}"))
        self.report(OK, "end of stream")
        # The last figures count most: the process may end next.
        self._diagnostics.wait_for_all_acked(Duration(seconds=_ACK_TIMEOUT_S))
        self.finished = self.finished or self.settings.exit_at_end

    def _acknowledged(self, topic: str) -> bool:
        return self._outputs[topic][0].wait_for_all_acked(Duration(seconds=_ACK_TIMEOUT_S))

    # ------------------------------------------------------------ lifecycle

    def on_configure(self, state: Any) -> TransitionCallbackReturn:
        """Build the stage and its endpoints."""
        outcome = self._transition(self._configure)
        return outcome if outcome != TransitionCallbackReturn.SUCCESS else super().on_configure(state)

    def _configure(self) -> None:
        self.failure = None
        self.configure()
        self.input(topics.END_OF_STREAM, self._on_end_of_stream, profile=qos.LATCH_READER, required=False)
        self.report(OK, "inactive")

    def on_activate(self, state: Any) -> TransitionCallbackReturn:
        """Accept messages from now on."""
        self.active = True
        self._announcer.reset()
        self.report(OK, "waiting for the other nodes")
        return super().on_activate(state)

    def on_deactivate(self, state: Any) -> TransitionCallbackReturn:
        """Drop messages from now on."""
        self.active = self._announced = False
        self.report(OK, "inactive")
        return super().on_deactivate(state)

    def on_cleanup(self, state: Any) -> TransitionCallbackReturn:
        """Drop endpoints and stage."""
        outcome = self._transition(self._cleanup)
        return outcome if outcome != TransitionCallbackReturn.SUCCESS else super().on_cleanup(state)

    def on_shutdown(self, state: Any) -> TransitionCallbackReturn:
        """Like cleanup, for good."""
        self.active = False
        return self._transition(self._cleanup)

    def _cleanup(self) -> None:
        for subscription in self._inputs.values():
            self.destroy_subscription(subscription)
        for publisher, _ in self._outputs.values():
            self.destroy_lifecycle_publisher(publisher)
        self._inputs.clear()
        self._outputs.clear()
        self._required.clear()
        self.cleanup()
        self.report(OK, "unconfigured")

    def _transition(self, action: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            with self._heard():
                action()
        except HatError as error:
            self.fail(error)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.get_logger().error(traceback.format_exc())
            self.fail(RunError(f"{type(error).__name__}: {error}"))
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def start(self) -> None:
        """Configure and activate, as a lifecycle manager would."""
        if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()
