"""Which frame a stage may process next: messages joined by exact stamp, calibration and prior there, epochs in order.

Nothing here depends on the order in which messages of different topics arrive.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from hat_ros.config import PriorConfig
from hat_ros.core.initial_pose import InitialPose
from hat_ros.core.sync import ExactJoin
from hat_ros.errors import RunError
from hat_ros.io import messages, topics
from hat_ros.tracking.prior import PriorBuffer
from hat_ros.types import Camera, Detection, Frame, PosePrior


@dataclass(frozen=True)
class JoinedFrame:
    """All that a stage needs of one frame.

    Attributes:
        stamp_ns: exposure stamp.
        admitted: its record of entry.
        items: the joined messages by topic.
        camera: the calibration in force, None for a stage that gets no image.
        prior: what the fused past tells about the frame, None without one.
        given: the initial pose that is in force from this frame on, None without one.
    """

    stamp_ns: int
    admitted: messages.Admitted
    items: dict[str, Any]
    camera: Camera | None
    prior: PosePrior | None
    given: InitialPose | None = None

    @property
    def frame_id(self) -> str:
        """``header.frame_id`` of the image."""
        return self.items[topics.ADMISSION].header.frame_id

    def image(self) -> tuple[Frame, Detection | None]:
        """The frame and detection of its ``/hat/frame`` message.

        Raises:
            RunError: the stage does not join ``/hat/frame``.
        """
        if self.camera is None:
            raise RunError(f"{topics.FRAME} is not joined")
        rgb, detection = messages.frame_from(self.items[topics.FRAME])
        return Frame(self.stamp_ns, rgb, self.camera), detection


class JoinedFrames:
    """Collects the messages of a stage and hands out complete frames in stamp order.

    Args:
        joined: topics of which every frame has one message, beside the admission.
        prior: configuration of priors, None for a stage that uses none.
        reset: called when a frame opens a new epoch: forget the target's state.
        live: a frame of which a message was lost is passed over, and its estimate is not waited for. The entrance lets
            the next one in only when it has given that frame up.
        takes_given: initial poses are waited for and handed out.

    Attributes:
        lost: frames that were passed over.
    """

    def __init__(
        self,
        joined: Sequence[str],
        prior: PriorConfig | None,
        reset: Callable[[], None],
        live: bool = False,
        takes_given: bool = False,
    ) -> None:
        self._join = ExactJoin((topics.ADMISSION, *joined))
        self._priors = None if prior is None else PriorBuffer(prior)
        self._reset = reset
        self._with_image = topics.FRAME in joined
        self._given: dict[int, InitialPose] = {}
        self._takes_given = takes_given
        self._cameras: list[tuple[int, Camera]] = []
        self._epoch: int | None = None  # of the last frame taken; None: the next one opens an epoch
        self._is_fresh = True
        self._newest_ns = 0
        self._live = live
        self.lost = 0

    def __len__(self) -> int:
        """Frames of which something is waiting."""
        return len(self._join)

    @property
    def late(self) -> int:
        """Messages that came for frames that had been passed already."""
        return self._join.late

    def missing(self) -> tuple[int, tuple[str, ...]] | None:
        """The oldest waiting stamp and the topics it lacks."""
        return self._join.missing()

    def put(self, topic: str, message: Any) -> None:
        """Add a message of a joined topic.

        Admissions come in the order of entry and once for each frame. So one whose stamp is not later than the last
        tells that the stamps begin anew, which the entrance allows only in a new epoch, with no frame under way.
        """
        stamp_ns = messages.stamp_of(message)
        if topic == topics.ADMISSION:
            if stamp_ns <= self._newest_ns:
                self._join.restart(topic, stamp_ns)
                self._epoch = None
            self._newest_ns = stamp_ns
        self._join.put(topic, stamp_ns, message)

    def put_camera(self, message: Any) -> None:
        """Add a calibration, in force from its stamp on; later stamps than its own are those of an old epoch."""
        stamp_ns = messages.stamp_of(message)
        self._cameras = [item for item in self._cameras if item[0] < stamp_ns]
        self._cameras.append((stamp_ns, messages.camera_from(message)))

    def put_given(self, message: Any) -> None:
        """Add an initial pose, in force from the frame of its stamp on."""
        self._given[messages.stamp_of(message)] = messages.initial_pose_from(message)

    def put_status(self, message: Any) -> None:
        """Add a fused pose of the past."""
        if self._priors is not None:
            self._priors.push(messages.status_from(message).estimate)

    def take(self) -> JoinedFrame | None:
        """The next frame, None while something that it needs has not arrived.

        Raises:
            RunError: a message was lost, in a replay.
            WireError: the admission is malformed.
        """
        head = self._join.peek()
        if head is None:
            return None
        stamp_ns, items = head
        admitted = messages.admitted_from(items[topics.ADMISSION])
        if admitted.epoch != self._epoch:
            self._enter(admitted.epoch)
            self._join.drop_before(stamp_ns)  # given up in the old epoch, never to be completed
        if self._priors is not None:
            self._priors.admit(stamp_ns)
            if not self._live and not self._priors.ready(stamp_ns):
                return None
        camera = self._camera_at(stamp_ns)
        if (camera is None and self._with_image) or self._awaits_given(stamp_ns, admitted):
            return None
        if self._live:
            self._pass_over(stamp_ns)
        self._join.take()
        prior = None if self._priors is None else self._priors.before(stamp_ns)
        return JoinedFrame(stamp_ns, admitted, items, camera, prior, self._given.pop(stamp_ns, None))

    def _awaits_given(self, stamp_ns: int, admitted: messages.Admitted) -> bool:
        """Whether a frame's initial pose is still to come; a frame that is not the newest, live, was given up."""
        if not (self._takes_given and admitted.initial_pose) or stamp_ns in self._given:
            return False
        return not (self._live and stamp_ns < self._newest_ns)

    def _pass_over(self, stamp_ns: int) -> None:
        """Frames before this one that are not complete, or were never answered, have been given up."""
        missing = self._join.missing()
        if missing is not None and missing[0] < stamp_ns:
            self.lost += 1
            self._join.drop_before(stamp_ns)
        if self._priors is not None:
            self._priors.drop_unanswered(stamp_ns)

    def _enter(self, epoch: int) -> None:
        if not self._is_fresh:
            self._reset()
            if self._priors is not None:
                self._priors.reset()
        self._epoch, self._is_fresh = epoch, False

    def _camera_at(self, stamp_ns: int) -> Camera | None:
        """The newest calibration that is not newer than the stamp."""
        while len(self._cameras) > 1 and self._cameras[1][0] <= stamp_ns:
            self._cameras.pop(0)
        return self._cameras[0][1] if self._cameras and self._cameras[0][0] <= stamp_ns else None
