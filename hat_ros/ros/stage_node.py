"""A stage of the method as a node: joins its inputs by exact stamp, calls the stage, answers once per frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol

from hat_ros.io import topics
from hat_ros.ros.diagnostics import WARN
from hat_ros.ros.joined_frames import JoinedFrame, JoinedFrames
from hat_ros.ros.node import HatNode
from hat_ros.ros.pacing import ExtraDelay, StepTimer
from hat_ros.ros.session import Session


class Resettable(Protocol):
    """What a node needs of its stage beside ``update``."""

    def reset(self) -> None:
        """Forget the target's state."""
        ...


class StageSession(Session, ABC):
    """Feeds one stage object frame by frame.

    Args:
        node: its node.
        stage: the stage object; it is reset when a new epoch begins.
        joined: topics of which the stage needs one message per frame, beside the admission.
        uses_prior: the stage takes fused poses of the past, if the configuration enables them.
        takes_given: the stage takes initial poses.
    """

    def __init__(
        self,
        node: HatNode[Session],
        stage: Resettable,
        joined: Sequence[str],
        uses_prior: bool = False,
        takes_given: bool = False,
    ) -> None:
        config = node.settings.config
        self._diagnostics = node.diagnostics
        prior = config.prior if uses_prior else None
        self._frames = JoinedFrames(joined, prior, stage.reset, node.settings.live, takes_given)
        self._delay = ExtraDelay(node.NAME, config.graph.debug_stage_delay_ms)
        self._step_timer = StepTimer()
        self._answered = 0
        if topics.FRAME in joined:
            node.endpoints.input(topics.HAT_CAMERA_INFO, partial(self._receive, self._frames.put_camera))
        for topic in (topics.ADMISSION, *joined):
            node.endpoints.input(topic, partial(self._receive, partial(self._frames.put, topic)))
        if uses_prior and config.prior.enabled:
            node.endpoints.input(topics.STATUS, partial(self._receive, self._frames.put_status))
        if takes_given:
            put = partial(self._receive, self._frames.put_given)
            node.endpoints.input(topics.GIVEN_POSE, put, required=False)

    @abstractmethod
    def step(self, joined: JoinedFrame) -> None:
        """Process one frame. Exactly one answer must be published."""

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics."""
        counts = {
            "answered": self._answered,
            "waiting": len(self._frames),
            "late": self._frames.late,
            "lost": self._frames.lost,
        }
        return counts | self._step_timer.values()

    def every_second(self) -> None:
        """Report what the oldest waiting frame lacks."""
        missing = self._frames.missing()
        if missing is not None and len(self._frames) > 1:
            self._diagnostics.report(WARN, f"frame {missing[0]} waits for {', '.join(missing[1])}")

    def _receive(self, put: Callable[[Any], None], message: Any) -> None:
        put(message)
        while (joined := self._frames.take()) is not None:
            self._delay.wait()
            with self._step_timer.frame():
                self.step(joined)
            self._answered += 1
