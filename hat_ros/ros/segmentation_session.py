"""The entrance of the graph: admits frames by credit, numbers them, adds the mask."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

from rclpy.duration import Duration
from std_srvs.srv import Trigger

from hat_ros.core.initial_pose import InitialPose
from hat_ros.core.sync import RESTART_FRAMES
from hat_ros.errors import FrameError, InputError, RunError
from hat_ros.io import messages, topics
from hat_ros.io.calibration import calibration_from
from hat_ros.ros import qos
from hat_ros.ros.camera_input import CameraInput
from hat_ros.ros.camera_watch import CameraWatch
from hat_ros.ros.diagnostics import OK, STEADY, WARN
from hat_ros.ros.entrance import Entrance
from hat_ros.ros.frames_in_flight import FramesInFlight
from hat_ros.ros.node import HatNode
from hat_ros.ros.pacing import ExtraDelay, StepTimer
from hat_ros.ros.session import Session
from hat_ros.segmentation.stage import SegmentationStage
from hat_ros.tracking.prior import PriorBuffer
from hat_ros.types import Frame, TrackState

_TRANSPORTS = {
    "auto": (topics.IMAGE, topics.IMAGE_COMPRESSED),
    "raw": (topics.IMAGE,),
    "compressed": (topics.IMAGE_COMPRESSED,),
}
_STAGES = {"hypotheses", "slam", "selector", "fusion"}


class SegmentationSession(Session):
    """Admits a frame while it has a credit (W in replay, 1 live) and the whole graph is matched."""

    def __init__(self, node: HatNode[Session]) -> None:
        config, live = node.settings.config, node.settings.live
        annotated = config.segmentation.backend == "annotated"
        self._node, self._wire, self._diagnostics = node, node.wire, node.diagnostics
        self._stage = SegmentationStage(config, node.settings.load_target())
        self._priors = PriorBuffer(config.prior)
        self._entrance = Entrance(live, annotated, config.camera.image_depth)
        self._config = config.graph
        self._rectified = config.camera.rectified
        self._image_topic = node.resolve_topic_name(topics.relative(topics.IMAGE))
        # A record tells frames by their stamps: there none may come twice.
        self._in_flight = FramesInFlight(config.graph, live, restarts=live and not node.settings.recorded)
        self._epoch = 0
        self._last_state, self._resumed = TrackState.UNINITIALISED, False
        self._camera_sent = self._is_open = False
        self._given: tuple[InitialPose, str] | None = None  # a pose that waits for the next frame, and its frame_id
        self._ready_nodes: set[str] = set()
        self._delay = ExtraDelay(node.NAME, config.graph.debug_stage_delay_ms)
        self._step_timer = StepTimer()
        self._watch = CameraWatch()
        self._images, self._infos = self._subscribe(annotated, live, config.camera.transport)
        readers = ("fusion",) if config.refinement.enabled else ()
        self._camera_info = node.endpoints.output(topics.HAT_CAMERA_INFO, "hypotheses", "slam", *readers)
        self._admission = node.endpoints.output(topics.ADMISSION, *sorted(_STAGES))
        self._frame = node.endpoints.output(topics.FRAME, "hypotheses", "slam", *readers)
        self._given_pose = node.endpoints.output(topics.GIVEN_POSE, "hypotheses")
        self._service = node.create_service(Trigger, topics.relative(topics.RESET), self._on_reset)
        self._timer = node.create_timer(0.1, partial(node.guarded, self._check_time), clock=STEADY)

    def _subscribe(self, annotated: bool, live: bool, transport: str) -> tuple[CameraInput, CameraInput]:
        node, endpoints = self._node, self._node.endpoints
        subscribe = endpoints.input
        images = CameraInput(node, endpoints, _TRANSPORTS[transport if live else "auto"], live, self._on_image)
        infos = CameraInput(node, endpoints, (topics.CAMERA_INFO,), live, self._on_camera_info)
        if annotated:
            subscribe(topics.DETECTION_MASK, self._on_mask, profile=qos.IN_REPLAY, required=not live)
        if live:
            subscribe(topics.INITIAL_POSE, self._on_initial_pose, required=False)
        subscribe(topics.STATUS, self._on_status)
        subscribe(topics.READY, self._on_ready, profile=qos.LATCH_READER, required=False)
        return images, infos

    def every_second(self) -> None:
        """Look again for the camera, a second one, and for stages that are gone."""
        self._expect_one_camera()
        if not self._node.settings.live:  # a replay has one who watches its processes
            return
        self._judge_camera()
        gone = self._node.endpoints.gone(topics.ADMISSION) if self._is_open else []
        if gone:
            self._ready_nodes.difference_update(gone)
            self._lose(f"{', '.join(gone)}: gone")

    def _expect_one_camera(self) -> None:
        """Notice a second camera on the same topic: the frames of both would be one sequence.

        Raises:
            RunError: there is one, in a replay.
        """
        self._infos.follow()
        names = self._images.follow()
        if len(names) < 2:
            return
        topic = self._images.describe()
        sentence = f"{topic} has {len(names)} publishers ({', '.join(names)}): stop all but one, or remap image"
        if not self._node.settings.live:
            raise RunError(sentence)
        self._entrance.forget_numbers()  # those of several publishers do not belong together
        self._diagnostics.report(WARN, sentence)

    def _judge_camera(self) -> None:
        """Say that the camera is silent, is back, or is faster than the graph."""
        if self._images.topic is None:
            self._diagnostics.report(WARN, f"no camera on {self._images.describe()}")
        was_silent, silence = self._watch.is_silent, self._watch.silence()
        if silence is not None:
            self._diagnostics.report(silence[0], f"{silence[1]} on {self._images.describe()}")
        if self._watch.is_silent != was_silent:
            if was_silent:
                self._node.get_logger().info(f"{self._images.describe()}: back")
            else:
                self._node.get_logger().warning(f"{self._images.describe()}: silent")
        overload = self._watch.overload(self._entrance.dropped_total)
        if overload is not None and self._watch.is_overloaded:
            self._warn(overload)
        elif overload is not None:
            self._node.get_logger().info(overload)

    def close(self) -> None:
        """Drop the service and the timer."""
        self._node.destroy_service(self._service)
        self._node.destroy_timer(self._timer)

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics."""
        in_flight = len(self._in_flight.admission.in_flight)
        counts = {
            "admitted": self._in_flight.admitted,
            "dropped": self._entrance.dropped_total,
            "in_flight": in_flight,
            "given_up": self._in_flight.given_up,
            "image_age_s": f"{self._watch.age_s:.3f}",
            "refused": self._entrance.refusals.total,
            topics.REFUSED_REASONS: json.dumps(self._entrance.refusals.records()),
        }
        return counts | self._step_timer.values()

    def _on_image(self, topic: str, message: Any, info: dict[str, Any]) -> None:
        self._watch.note_image()
        self._entrance.add_image(topic, message, info["publication_sequence_number"])
        self._pump()

    def _on_mask(self, message: Any) -> None:
        self._entrance.add_mask(message)
        self._pump()

    def _on_camera_info(self, topic: str, message: Any, info: dict[str, Any]) -> None:
        calibration = calibration_from(message, self._image_topic, self._rectified)
        if calibration is None:
            self._diagnostics.report(
                WARN, f"{topics.CAMERA_INFO} says that the camera is not calibrated: K has no focal length"
            )
            return
        if self._entrance.set_calibration(calibration):
            self._camera_sent = False
            self._new_epoch()
        self._pump()

    def _on_initial_pose(self, message: Any) -> None:
        try:
            self._given = messages.initial_pose_from(message), message.header.frame_id
        except InputError as error:
            self._warn(f"{topics.INITIAL_POSE} refused: {error}")

    def _take_initial_pose(self, stamp_ns: int, frame_id: str) -> InitialPose | None:
        """What has been given since the last frame; hypotheses and the record get it with this frame's stamp."""
        given, self._given = self._given, None
        if given is None:
            return None
        pose, its_frame_id = given
        if its_frame_id not in ("", frame_id):
            self._warn(
                f"{topics.INITIAL_POSE} refused: it is in frame '{its_frame_id}', the images are in '{frame_id}'"
            )
            return None
        message = self._wire.pose_with_covariance(stamp_ns, frame_id, pose.pose_row, pose.covariance)
        self._given_pose.publish(message)
        return pose

    def _on_status(self, message: Any) -> None:
        estimate = messages.status_from(message).estimate
        self._priors.push(estimate)
        self._last_state = estimate.state
        if self._in_flight.leave(estimate.stamp_ns):
            self._diagnostics.report(OK, "running")
        self._pump()

    def _on_ready(self, message: Any) -> None:
        name, is_ready = message.frame_id, message.stamp.sec > 0  # of the wall clock; 0: not any more
        if self._node.settings.live and self._is_open and name in self._ready_nodes & _STAGES:
            self._lose(f"{name}: {'started again' if is_ready else 'stopped'}")
        (self._ready_nodes.add if is_ready else self._ready_nodes.discard)(name)
        self._pump()

    def _lose(self, what: str) -> None:
        """A stage has lost its state and what was under way there: give that up at once, go on in a new epoch."""
        lost = self._in_flight.give_up()
        sentence = f"{what}; {lost} frames were under way, a new epoch begins when all stages are ready"
        self._is_open = False
        self._new_epoch(resumed=self._last_state.is_confirmed)
        self._warn(sentence)

    def _warn(self, sentence: str) -> None:
        self._node.get_logger().warning(sentence)
        self._diagnostics.report(WARN, sentence)

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Forget the target; live, also what is under way and the newest stamp."""
        if self._node.settings.live:
            self._in_flight.give_up()
            self._in_flight.admission.forget_stamps()
            self._camera_sent = False  # in force from the next stamp on, whatever that is
        self._new_epoch()
        response.success, response.message = True, f"epoch {self._epoch} begins with the next frame"
        return response

    def _pump(self) -> None:
        if not self._is_open:
            self._is_open = self._ready_nodes >= _STAGES and not self._node.endpoints.unmatched()
            if self._is_open:  # before the first frame: a short recording is over within a second
                self._expect_one_camera()
        while self._is_open and self._in_flight.admission.has_credit:
            try:
                found = self._entrance.next_frame(self._in_flight.admission)
            except FrameError as error:
                self._diagnostics.report(WARN, str(error))
                continue
            if found is None:
                return
            self._admit(*found)

    def _admit(self, frame: Frame, frame_id: str) -> None:
        stamp_ns = frame.stamp_ns
        if self._in_flight.admission.begins_anew(stamp_ns):
            self._begin_anew(stamp_ns)
        if not self._camera_sent:
            self._camera_sent = True
            self._camera_info.publish(self._wire.camera_info(stamp_ns, frame_id, frame.camera))
            # It must be there before its first image; live, a reader that has just died must not stop all others.
            limit_s = self._config.live_timeout_s if self._node.settings.live else 5.0
            self._camera_info.wait_for_all_acked(Duration(seconds=limit_s))
        seq = self._in_flight.enter(stamp_ns)
        given = self._take_initial_pose(stamp_ns, frame_id)
        admitted = messages.Admitted(
            seq, self._entrance.dropped_total, self._epoch, int(self._resumed), int(given is not None)
        )
        self._admission.publish(self._wire.admission(stamp_ns, frame_id, admitted))
        self._delay.wait()
        with self._step_timer.frame():
            detection = self._stage.update(frame, self._priors.before(stamp_ns), given)
            self._frame.publish(self._wire.frame(stamp_ns, frame_id, frame.rgb, detection))

    def _begin_anew(self, stamp_ns: int) -> None:
        """The camera's clock has stepped back: a new epoch, and the calibration in force from this stamp on."""
        sentence = (
            f"header.stamp steps back from {self._in_flight.admission.last_stamp_ns} ns to {stamp_ns} ns, "
            f"{RESTART_FRAMES} frames in a row: a new epoch begins, the target is sought anew"
        )
        self._warn(sentence)
        self._camera_sent = False
        self._new_epoch()

    def _check_time(self) -> None:
        """A stage that does not answer: a replay ends, a live graph goes on with the next frame."""
        if self._images.topic is None or self._infos.topic is None:
            self._expect_one_camera()
        overdue = self._in_flight.overdue()
        if overdue is not None:
            self._node.fail(overdue)
        elif self._is_open and len(self._entrance) and not self._entrance.is_calibrated:
            self._diagnostics.report(WARN, f"images arrive, but no calibration on {topics.CAMERA_INFO}")
        self._pump()

    def _new_epoch(self, resumed: bool = False) -> None:
        """Every stage starts afresh; ``resumed``: with a target that was confirmed and has not been lost."""
        self._epoch += 1
        self._resumed = resumed
        if not resumed:
            self._last_state = TrackState.UNINITIALISED
        self._stage.reset()
        self._priors.reset()
