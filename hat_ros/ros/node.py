"""What all nodes share: parameters, the lifecycle, errors of callbacks, readiness, the end of the stream.

rclpy swallows exceptions of lifecycle callbacks and stops an executor on those of others, so both are caught here,
once: a node that fails reports it in one sentence, in ``/diagnostics`` and on stderr, and the process ends in a replay.
"""

from __future__ import annotations

import os
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Generic, TypeVar

from rclpy.context import Context
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.parameter import Parameter

from hat_ros.errors import HatError, RunError
from hat_ros.io import topics
from hat_ros.io.messages import Wire, message_class
from hat_ros.ros import qos
from hat_ros.ros.diagnostics import ERROR, OK, STEADY, Diagnostics
from hat_ros.ros.endpoints import PREFIX, Endpoints
from hat_ros.ros.params import declare_parameters
from hat_ros.ros.session import Session

_ACK_TIMEOUT_S = 10.0
# A fault of every frame would fill the console.
_LOG_PERIOD_S = 1.0

SessionT_co = TypeVar("SessionT_co", bound=Session, covariant=True)


class HatNode(LifecycleNode, ABC, Generic[SessionT_co]):
    """A lifecycle node, ``hat_`` and its ``NAME``; what it does is in its :class:`~hat_ros.ros.session.Session`.

    It lives in the namespace that it is started with, and all its topics but those of the whole machine do, too.

    Attributes:
        settings: the values of all parameters.
        wire: encodes messages.
        diagnostics: the reported state.
        endpoints: publishers and subscriptions of the session.
        active: the lifecycle state is active; messages that arrive otherwise are dropped.
        failure: what stopped the node, None while all is well.
        finished: the stream ended and everything sent was acknowledged.
    """

    NAME: ClassVar[str]
    EXTRA_PARAMETERS: ClassVar[dict[str, tuple[Any, str]]] = {}
    GOES_ON_LIVE: ClassVar[bool] = True

    def __init__(self, *, context: Context | None = None, parameters: dict[str, Any] | None = None) -> None:
        super().__init__(
            f"{PREFIX}{self.NAME}",
            context=context,
            parameter_overrides=[Parameter(name, value=value) for name, value in (parameters or {}).items()],
            automatically_declare_parameters_from_overrides=True,
        )
        self.settings = declare_parameters(self, self.EXTRA_PARAMETERS)
        self.wire = Wire.ros()
        self.active = self.finished = False
        self.failure: HatError | None = None
        self._session: SessionT_co | None = None
        self._announced = False
        self.endpoints = Endpoints(self, self.settings.live, self.settings.recorded, self.guarded, lambda: self.active)
        self.diagnostics = Diagnostics(self, self.NAME, self.wire, self.values)
        self._ready = self.create_publisher(
            message_class(topics.TYPES[topics.READY]), topics.relative(topics.READY), qos.LATCH
        )
        self.create_timer(1.0, self._every_second, clock=STEADY)
        self._announcer = self.create_timer(0.02, self._announce, clock=STEADY)

    @abstractmethod
    def open_session(self) -> SessionT_co:
        """Build what the node owns while it is configured, endpoints included."""

    @property
    def session(self) -> SessionT_co:
        """What the node owns.

        Raises:
            RunError: the node is not configured.
        """
        if self._session is None:
            raise RunError(f"node '{self.NAME}' is not configured")
        return self._session

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics; none before the node is configured."""
        return {} if self._session is None else self._session.values()

    # ------------------------------------------------------------ errors

    def guarded(self, callback: Callable[..., None], *args: Any) -> None:
        """Run a callback while active; an exception becomes a failure with one sentence."""
        if not self.active:
            return
        try:
            with self.diagnostics.relayed_log():
                callback(*args)
        except HatError as error:
            self.fail(error)
        except Exception as error:
            self.get_logger().error(traceback.format_exc())
            self.fail(RunError(f"{type(error).__name__}: {error}"))

    def fail(self, error: HatError) -> None:
        """Report what went wrong; a replay ends, a live graph goes on without the frame, in a new epoch."""
        self.get_logger().error(str(error), throttle_duration_sec=_LOG_PERIOD_S)
        self.diagnostics.report(ERROR, str(error))
        if not (self.settings.live and self.active and self.GOES_ON_LIVE):
            self.failure = error
        elif self._announced:
            self._say_ready()

    # ------------------------------------------------------------ timers, end of the stream

    def _announce(self) -> None:
        if not self.active or self._announced:
            return
        unmatched = self.endpoints.unmatched()
        if not unmatched:
            self._announced = True
            self._announcer.cancel()
            self._say_ready()
        self.diagnostics.report(OK, "ready" if not unmatched else f"waiting for {', '.join(unmatched)}")

    def _say_ready(self, ready: bool = True) -> None:
        """Tell the others; said again, it means that what was under way here is lost. Without a stamp: not ready."""
        self._ready.publish(self.wire.header(time.time_ns() if ready else 0, self.NAME))

    def check_supervisor(self) -> None:
        """Fail when the process that had started this one is gone."""
        supervisor = self.settings.supervisor_pid
        if supervisor and os.getppid() != supervisor:
            self.failure = RunError(f"process {supervisor}, which had started this node, is gone")

    def _every_second(self) -> None:
        self.check_supervisor()
        if self.active:
            self.guarded(self.session.every_second)
        self.diagnostics.publish()

    def _on_end_of_stream(self, message: Any) -> None:
        """The last status is out: make sure that everything sent has arrived."""
        stuck = self.endpoints.unacknowledged(_ACK_TIMEOUT_S)
        if stuck:
            self.fail(RunError(f"not acknowledged by all readers at the end of the stream: {', '.join(stuck)}"))
        self.diagnostics.report(OK, "end of stream")
        # The last figures count most: the process may end next.
        self.diagnostics.wait_for_readers(_ACK_TIMEOUT_S)
        self.finished = self.finished or self.settings.exit_at_end

    # ------------------------------------------------------------ lifecycle

    def on_configure(self, state: Any) -> TransitionCallbackReturn:
        """Build the session."""
        outcome = self._transition(self._configure)
        if outcome == TransitionCallbackReturn.SUCCESS:
            return super().on_configure(state)
        self.endpoints.clear()
        return outcome

    def _configure(self) -> None:
        self.failure = None
        self._session = self.open_session()
        end = topics.END_OF_STREAM
        self.endpoints.input(end, self._on_end_of_stream, profile=qos.LATCH_READER, required=False)
        self.diagnostics.report(OK, "inactive")

    def on_activate(self, state: Any) -> TransitionCallbackReturn:
        """Accept messages from now on."""
        self.active = True
        self._announcer.reset()
        self.diagnostics.report(OK, "waiting for the other nodes")
        self.endpoints.deliver_held()
        return super().on_activate(state)

    def on_deactivate(self, state: Any) -> TransitionCallbackReturn:
        """Drop messages from now on."""
        self._withdraw()
        self.diagnostics.report(OK, "inactive")
        return super().on_deactivate(state)

    def on_cleanup(self, state: Any) -> TransitionCallbackReturn:
        """Drop endpoints and session."""
        outcome = self._transition(self._cleanup)
        return outcome if outcome != TransitionCallbackReturn.SUCCESS else super().on_cleanup(state)

    def on_shutdown(self, state: Any) -> TransitionCallbackReturn:
        """Like cleanup; the node cannot be configured again."""
        self._withdraw()
        return self._transition(self._cleanup)

    def _withdraw(self) -> None:
        """Take no message any more, and say so."""
        if self._announced:
            self._say_ready(False)
        self.active = self._announced = False

    def _cleanup(self) -> None:
        self.endpoints.clear()
        self.release()
        self.diagnostics.report(OK, "unconfigured")

    def release(self) -> None:
        """Close the session, also outside the lifecycle (an interrupted process); harmless when there is none."""
        self._withdraw()
        session, self._session = self._session, None
        if session is not None:
            session.close()

    def _transition(self, action: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            with self.diagnostics.relayed_log():
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
