"""One replay: player and recorder in this process, spun until the stages have answered everything."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.executors import SingleThreadedExecutor

from hat_ros.errors import RunError, StageTimeoutError
from hat_ros.io import topics
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.messages import Status, Wire
from hat_ros.io.rosbag import TYPESTORE
from hat_ros.ros.diagnostics import BUSY
from hat_ros.ros.node import HatNode
from hat_ros.ros.playback import Playback
from hat_ros.ros.player_node import PlayerNode
from hat_ros.ros.process import close as close_nodes
from hat_ros.ros.recorder_node import RecorderNode
from hat_ros.ros.session import Session
from hat_ros.ros.stage_processes import StageProcesses

LOG = logging.getLogger(__name__)

# What each stage sends for every frame, in the order of the data flow; segmentation's own answer is an image.
_ANSWERS = (
    ("segmentation", topics.ADMISSION),
    ("hypotheses", topics.HYPOTHESES_SCORED),
    ("slam", topics.SLAM_STATE),
    ("selector", topics.SELECTION),
    ("fusion", topics.STATUS),
)
_EXIT_TIMEOUT_S = 20.0


@dataclass(frozen=True)
class Progress:
    """How far a replay is: frames answered of all, and the newest status."""

    done: int
    total: int
    status: Status


class ReplayRun:
    """Player and recorder beside the running stages.

    Args:
        executor: spins both; shut down by :meth:`close`.
        processes: the stages, started already; ended by :meth:`close`.
        bag: the recording.
        recorder: parameters of the recorder.
        player: parameters of the player.

    Raises:
        HatError: one of the two cannot be configured; nothing is left open.
    """

    def __init__(
        self,
        executor: SingleThreadedExecutor,
        processes: StageProcesses,
        bag: BagReader,
        recorder: dict[str, Any],
        player: dict[str, Any],
    ) -> None:
        self._executor, self._processes, self._bag = executor, processes, bag
        self._relayed: dict[str, str] = {}
        self._recorder_node = RecorderNode(context=executor.context, parameters=recorder)
        self._player_node = PlayerNode(context=executor.context, parameters=player)
        self._nodes: tuple[HatNode[Session], ...] = (self._recorder_node, self._player_node)
        try:
            for node in self._nodes:
                executor.add_node(node)
                node.start()
                if node.failure is not None:
                    raise node.failure
        except BaseException:
            close_nodes(executor, self._nodes)
            raise
        self._recorder = self._recorder_node.session
        self._player = self._player_node.session

    @property
    def playback(self) -> Playback:
        """Counts and times of what was played."""
        return self._player.playback

    def play(self, on_progress: Callable[[Progress], None] | None) -> None:
        """Play to the end.

        Raises:
            StageTimeoutError: a stage did not answer.
            HatError: a node failed or ended early.
        """
        done = 0
        while not self._player_node.finished:
            self._executor.spin_once(timeout_sec=0.1)
            self._check()
            self._relay()
            playback = self.playback
            # What is reported is also recorded.
            answered = min(playback.answered, self._recorder.counts[topics.STATUS])
            if answered != done and playback.last_status is not None:
                done = answered
                if on_progress is not None:
                    on_progress(Progress(done, playback.total, playback.last_status))
        self._await_exit()

    def _check(self) -> None:
        """Whatever went wrong, as one sentence."""
        self._processes.note_memory()
        ended = self._processes.ended()
        if ended is not None and not (ended[1] == 0 and self._player_node.finished):
            raise self._processes.cause_of_end(*ended, self.playback.answered, self._culprit())
        for node in self._nodes:
            if isinstance(node.failure, StageTimeoutError) and self.playback.sent:
                raise StageTimeoutError(f"{node.failure}: {self._culprit()}") from None
            if node.failure is not None:
                raise node.failure

    def _relay(self) -> None:
        """Log here what a node reports while it works on something that takes long."""
        for name, text in self._player.texts.items():
            if self._relayed.get(name) != text and text.startswith(BUSY):
                LOG.info("%s: %s", name, text.removeprefix(BUSY))
            self._relayed[name] = text

    def _culprit(self) -> str:
        """The first stage in the data flow that is behind the one before it."""
        newest, counts = self._recorder.newest_ns, self._recorder.counts
        for name, topic in _ANSWERS:
            if counts[topic] < counts[topics.ADMISSION] or not counts[topic]:
                return f"stage '{name}' has answered {counts[topic]} frames, the last at {newest[topic]} ns"
        return "every stage has answered what was admitted"

    def _await_exit(self) -> None:
        """The stages end once everything that they sent was acknowledged; then the recorder holds it all."""
        limit = time.monotonic() + _EXIT_TIMEOUT_S
        while self._processes.running:
            self._executor.spin_once(timeout_sec=0.05)
            self._check()
            if time.monotonic() > limit:
                raise RunError(f"the nodes did not end within {_EXIT_TIMEOUT_S:g} s after the end of the stream")
        while self._recorder.counts[topics.STATUS] < self.playback.answered and time.monotonic() < limit:
            self._executor.spin_once(timeout_sec=0.05)
        self._drain()
        self._check()

    def _drain(self) -> None:
        """Record what has arrived and lies in the readers' queues."""
        idle = 0
        while idle < 3:
            before = sum(self._recorder.counts.values())
            self._executor.spin_once(timeout_sec=0.02)
            idle = 0 if sum(self._recorder.counts.values()) > before else idle + 1

    def close(self) -> None:
        """Record what has arrived, end the processes, put the ground truth into the record, close the bag."""
        with contextlib.ExitStack() as stack:  # each of these, last first, whatever happens to the others
            stack.callback(close_nodes, self._executor, self._nodes)
            stack.callback(self._record_truth)
            stack.callback(self._processes.close)
            self._player_node.active = False
            self._drain()  # before the writers go: their unread messages go with them

    def _record_truth(self) -> None:
        """The ground truth goes from the bag into the record, past every node."""
        first, last = self._recorder.span_ns
        make = Wire.bag(TYPESTORE)
        for stamp_ns, row in sorted(self._bag.truth_rows().items()):
            if first <= stamp_ns <= last:
                message = make.pose(stamp_ns, self._bag.frame_id, row)
                self._recorder.writer.write_message(topics.GROUND_TRUTH, message, stamp_ns)
