"""A stage of the method as a node: joins its inputs by exact stamp, waits for its prior, calls the stage, answers."""

from __future__ import annotations

import random
import time
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

from hat_ros.core.sync import ExactJoin
from hat_ros.io import messages, topics
from hat_ros.ros.base import WARN, HatNode
from hat_ros.tracking.prior import PriorBuffer
from hat_ros.types import Camera, Detection, Frame, PosePrior

if TYPE_CHECKING:
    from hat_ros.target.model import Target


class ExtraDelay:
    """Random extra time per frame, for latency studies; never touches what is computed."""

    def __init__(self, name: str, longest_ms: float) -> None:
        self._random = random.Random(name)
        self._longest_s = 1e-3 * longest_ms

    def wait(self) -> None:
        """Sleep, if a delay was asked for."""
        if self._longest_s > 0:
            time.sleep(self._longest_s * self._random.random())


class StepTimer:
    """Mean wall time of a stage per frame, reading and writing its messages included; the first frames are left out."""

    WARMUP_FRAMES = 10

    def __init__(self) -> None:
        self._frames = 0
        self._seconds = 0.0

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Around the work on one frame."""
        start = time.perf_counter()
        yield
        self._frames += 1
        if self._frames > self.WARMUP_FRAMES:
            self._seconds += time.perf_counter() - start

    def values(self) -> dict[str, str]:
        """The figure for diagnostics, once there is one."""
        timed = self._frames - self.WARMUP_FRAMES
        return {topics.STEP_MS: f"{1e3 * self._seconds / timed:.4f}"} if timed > 0 else {}


class StageNode(HatNode):
    """Owns one stage object; :attr:`JOINED` are the topics that it needs of every frame, beside the admission.

    Attributes:
        target: the CAD model, None for a stage that needs none.
        stage: the stage object, with ``reset()``.
        priors: fused poses of the past, fed from ``/hat/status``.
    """

    JOINED: ClassVar[tuple[str, ...]]
    USES_PRIOR: ClassVar[bool] = False
    NEEDS_TARGET: ClassVar[bool] = True

    target: Target | None
    stage: Any
    _join: ExactJoin | None = None

    def configure(self) -> None:
        """Build the stage and subscribe to its inputs."""
        self.target = self.settings.load_target() if self.NEEDS_TARGET else None
        self.stage = self.create_stage()
        self.priors = PriorBuffer(self.settings.config.prior)
        self.cameras: list[tuple[int, Camera]] = []
        self._epoch: int | None = None
        self._answered = 0
        self._delay = ExtraDelay(self.NAME, self.settings.config.graph.debug_stage_delay_ms)
        self._step_timer = StepTimer()
        self._join = ExactJoin((topics.ADMISSION, *self.joined()))
        if topics.FRAME in self.joined():
            self.input(topics.HAT_CAMERA_INFO, self._on_camera_info)
        for topic in (topics.ADMISSION, *self.joined()):
            self.input(topic, partial(self._on_item, topic))
        if self.USES_PRIOR and self.settings.config.prior.enabled:
            self.input(topics.STATUS, self._on_status)

    def joined(self) -> tuple[str, ...]:
        """Topics of which one message per frame is needed."""
        return self.JOINED

    @abstractmethod
    def create_stage(self) -> Any:
        """Build the stage object from the configuration."""

    @abstractmethod
    def step(self, stamp_ns: int, frame_id: str, admitted: messages.Admitted, items: dict[str, Any]) -> None:
        """Process one frame: ``items`` are the messages by topic. Exactly one answer must be published."""

    def cleanup(self) -> None:
        """Drop the stage."""
        self.stage = self.target = None
        self._join = None

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics."""
        if self._join is None:
            return {}
        counts = {"answered": self._answered, "waiting": len(self._join), "late": self._join.late}
        return counts | self._step_timer.values()

    def every_second(self) -> None:
        """Say what the oldest waiting frame lacks."""
        missing = self._join.missing()
        if missing is not None and len(self._join) > 1:
            self.report(WARN, f"frame {missing[0]} waits for {', '.join(missing[1])}")

    def _on_camera_info(self, message: Any) -> None:
        self.cameras.append((messages.stamp_of(message), messages.camera_from(message)))
        self._pump()

    def _on_status(self, message: Any) -> None:
        self.priors.push(messages.status_from(message).estimate)
        self._pump()

    def _on_item(self, topic: str, message: Any) -> None:
        self._join.put(topic, messages.stamp_of(message), message)
        self._pump()

    def _pump(self) -> None:
        while (head := self._join.peek()) is not None:
            stamp_ns, items = head
            admitted = messages.admitted_from(items[topics.ADMISSION])
            if admitted.epoch != self._epoch:
                self._enter_epoch(admitted.epoch)
                self._join.drop_before(stamp_ns)  # given up in the old epoch, never to be completed
            self.priors.admit(stamp_ns)
            if not self._may_start(stamp_ns):
                return
            self._join.take()
            self._delay.wait()
            with self._step_timer.frame():
                self.step(stamp_ns, items[topics.ADMISSION].header.frame_id, admitted, items)
            self._answered += 1

    def _may_start(self, stamp_ns: int) -> bool:
        if self.USES_PRIOR and not self.priors.ready(stamp_ns):
            return False
        return topics.FRAME not in self.joined() or any(since <= stamp_ns for since, _ in self.cameras)

    def _enter_epoch(self, epoch: int) -> None:
        """A new epoch means: forget the target's state, frames that were given up included."""
        if self._epoch is not None:
            self.stage.reset()
            self.priors.reset()
        self._epoch = epoch

    def frame_of(self, stamp_ns: int, message: Any) -> tuple[Frame, Detection | None]:
        """The frame and detection of a ``/hat/frame`` message, with the calibration in force at its stamp."""
        rgb, detection = messages.frame_from(message)
        while len(self.cameras) > 1 and self.cameras[1][0] <= stamp_ns:
            self.cameras.pop(0)
        return Frame(stamp_ns, rgb, self.cameras[0][1]), detection

    def prior_of(self, stamp_ns: int) -> PosePrior | None:
        """What the fused past says about this frame."""
        return self.priors.before(stamp_ns)
