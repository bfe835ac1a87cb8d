"""Lifecycle of a node, its diagnostics, and what it does with messages."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn

import hat_ros
from hat_ros.errors import ConfigError, RunError, StageTimeoutError
from hat_ros.io import images, messages, topics
from hat_ros.ros import process, qos
from hat_ros.ros.diagnostics import ERROR, OK
from hat_ros.ros.joined_frames import JoinedFrames
from hat_ros.ros.node import HatNode
from hat_ros.ros.overlay_node import OverlayNode
from hat_ros.ros.player_node import PlayerNode
from hat_ros.ros.recorder_node import RecorderNode
from hat_ros.ros.selector_node import SelectorNode
from hat_ros.ros.slam_node import SlamNode
from hat_ros.types import Camera, Candidates, Estimate, Motion, TrackState

PACKAGE = Path(hat_ros.__file__).parent


@pytest.fixture
def executor():
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=115)
    executor = SingleThreadedExecutor(context=context)
    yield executor
    process.close(executor, [node for node in executor.get_nodes() if isinstance(node, HatNode)])
    context.try_shutdown()


def add(executor, node_class, **parameters):
    node = node_class(context=executor.context, parameters=parameters)
    executor.add_node(node)
    return node


def state_of(node):
    return node._state_machine.current_state[1]


def test_a_node_goes_through_its_lifecycle_and_back(executor):
    node = add(executor, SelectorNode)
    for transition, state in [
        (node.trigger_configure, "inactive"),
        (node.trigger_activate, "active"),
        (node.trigger_deactivate, "inactive"),
        (node.trigger_cleanup, "unconfigured"),
        (node.trigger_configure, "inactive"),
        (node.trigger_shutdown, "finalized"),
    ]:
        assert transition() == TransitionCallbackReturn.SUCCESS
        assert state_of(node) == state
    assert node.failure is None


def test_a_node_that_cannot_be_configured_says_why_and_stays_unconfigured(executor):
    node = add(executor, SlamNode)
    node.start()
    assert state_of(node) == "unconfigured"
    assert isinstance(node.failure, ConfigError)
    assert "parameter 'target' is empty" in str(node.failure)


class PreparingNode(SelectorNode):
    """Says what it does while it configures, as the learned backends do."""

    def open_session(self):
        logging.getLogger("hat_ros.hypotheses.any").info("encoded %d of %d templates", 8, 162)
        self.text_meanwhile = self.diagnostics.text
        return super().open_session()


def test_long_preparations_show_in_diagnostics_while_they_last(executor, caplog):
    node = add(executor, PreparingNode)
    handlers = list(logging.getLogger("hat_ros").handlers)
    with caplog.at_level(logging.INFO, "hat_ros"):
        node.start()
    assert node.text_meanwhile == "busy: encoded 8 of 162 templates"
    assert node.diagnostics.text == "waiting for the other nodes"
    assert logging.getLogger("hat_ros").handlers == handlers


def test_a_node_that_says_something_new_is_not_given_up(executor, clean_bag):
    player = add(executor, PlayerNode, bag=str(clean_bag), config="default")
    player.start()
    session, playback = player.session, player.session.playback
    progress = []
    for text in ("busy: 8 of 162", "busy: 8 of 162", "busy: 16 of 162"):
        playback.progress_s = 0.0
        session.on_diagnostics(player.wire.diagnostics(0, "hat: hypotheses", OK, text, {}))
        progress.append(playback.progress_s > 0.0)
    assert progress == [True, False, True]
    playback.progress_s = 0.0
    with pytest.raises(StageTimeoutError, match=r"hypotheses: busy: 16 of 162.*raise graph\.startup_timeout_s"):
        session.feed()


def spin_until(executor, condition, turns=200):
    for _ in range(turns):
        if condition():
            return True
        executor.spin_once(timeout_sec=0.02)
    return False


def test_messages_are_ignored_unless_active_and_a_lost_one_is_noticed(executor):
    node = add(executor, SelectorNode)
    node.trigger_configure()
    make = messages.Wire.ros()

    def publish(stamp, *names):
        by_topic = {
            topics.ADMISSION: make.admission(stamp, "c", messages.Admitted(0, 0, 0)),
            topics.HYPOTHESES_SCORED: make.candidates(stamp, "c", Candidates.none()),
            topics.SLAM_STATE: make.motion(stamp, "c", Motion.none()),
        }
        for name in names:
            publishers[name].publish(by_topic[name])

    sender = rclpy.create_node("sender", context=executor.context)
    executor.add_node(sender)
    all_three = (topics.ADMISSION, topics.HYPOTHESES_SCORED, topics.SLAM_STATE)
    publishers = {
        name: sender.create_publisher(messages.message_class(topics.TYPES[name]), name, qos.STAGE) for name in all_three
    }
    assert spin_until(executor, lambda: all(p.get_subscription_count() == 1 for p in publishers.values()))
    publish(1, *all_three)
    spin_until(executor, lambda: False, turns=15)
    assert node.values()["answered"] == 0
    node.trigger_activate()
    publish(2, *all_three)
    assert spin_until(executor, lambda: node.values()["answered"] == 1)
    publish(3, topics.ADMISSION, topics.SLAM_STATE)
    publish(4, *all_three)
    assert spin_until(executor, lambda: node.failure is not None)
    assert "a message was lost: frame 3 never had /hat/hypotheses_scored" in str(node.failure)
    sender.destroy_node()


def test_a_malformed_message_fails_the_node_with_its_sentence(executor):
    node = add(executor, SelectorNode)
    node.start()
    make, frames = messages.Wire.ros(), JoinedFrames((), None, lambda: None)
    frames.put(topics.ADMISSION, make.table(5, "c", ("a",), [[1.0]]))
    node.guarded(frames.take)
    assert "table columns must be seq dropped_total epoch, found a" in str(node.failure)


def test_diagnostics_come_once_a_second_and_on_change(executor):
    node = add(executor, SelectorNode)
    seen = []
    listener = rclpy.create_node("listener", context=executor.context)
    executor.add_node(listener)
    listener.create_subscription(
        messages.message_class(topics.TYPES[topics.DIAGNOSTICS]), topics.DIAGNOSTICS, seen.append, qos.OUT
    )
    assert spin_until(executor, lambda: len(seen) >= 2, turns=400)
    before = len(seen)
    node.diagnostics.report(ERROR, "something new")
    assert spin_until(executor, lambda: len(seen) > before)
    assert (seen[-1].status[0].name, seen[-1].status[0].level) == ("hat: selector", b"\x02")
    listener.destroy_node()


def test_recorder_needs_a_place_to_write(executor):
    node = add(executor, RecorderNode)
    node.start()
    assert "parameter 'out' is empty" in str(node.failure)


def test_overlay_is_drawn_for_whoever_looks_and_images_come_only_then(executor, model):
    node = add(executor, OverlayNode, target=str(model))
    node.start()
    assert not node.endpoints.has_input(topics.FRAME)
    viewer = rclpy.create_node("viewer", context=executor.context)
    executor.add_node(viewer)
    seen = []

    def publisher(topic):
        return viewer.create_publisher(messages.message_class(topics.TYPES[topic]), topic, qos.profile_of(topic))

    send = {topic: publisher(topic) for topic in (topics.HAT_CAMERA_INFO, topics.FRAME, topics.STATUS)}
    subscription = viewer.create_subscription(
        messages.message_class(topics.TYPES[topics.OVERLAY]), topics.OVERLAY, seen.append, qos.DEBUG
    )
    assert spin_until(executor, lambda: node.endpoints.has_input(topics.FRAME), turns=400)
    assert spin_until(executor, lambda: all(p.get_subscription_count() for p in send.values()))
    make, camera = messages.Wire.ros(), Camera(np.array([[100.0, 0, 31.5], [0, 100, 23.5], [0, 0, 1]]), 64, 48)
    estimate = Estimate(7, TrackState.TRACKING, np.array([0, 0, 9.0, 0, 0, 0, 1]), np.eye(6))
    send[topics.HAT_CAMERA_INFO].publish(make.camera_info(7, "c", camera))
    send[topics.FRAME].publish(make.frame(7, "c", np.zeros((48, 64, 3), np.uint8), None))
    spin_until(executor, lambda: False, turns=20)
    send[topics.STATUS].publish(make.status("c", estimate, messages.Admitted(0, 0, 0)))
    assert spin_until(executor, lambda: seen)
    drawn = images.decode_image(seen[0])
    assert drawn.shape == (48, 64, 3)
    assert drawn.max() > 100
    assert seen[0].header.frame_id == "c"
    viewer.destroy_subscription(subscription)
    assert spin_until(executor, lambda: not node.endpoints.has_input(topics.FRAME), turns=400)
    viewer.destroy_node()


def test_a_node_without_a_session_says_so(executor):
    node = add(executor, SelectorNode)
    assert node.values() == {}
    with pytest.raises(RunError, match="node 'selector' is not configured"):
        _ = node.session
    node.trigger_configure()
    first = node.session
    node.trigger_cleanup()
    node.trigger_configure()
    assert node.session is not first, "a new session for each configuration"


def test_a_failed_configuration_leaves_no_endpoints(executor):
    class HalfWay(SelectorNode):
        def open_session(self):
            super().open_session()
            raise ConfigError("no")

    node = add(executor, HalfWay)
    before = len(list(node.subscriptions))
    node.start()
    assert len(list(node.subscriptions)) == before
    assert not node.endpoints.has_input(topics.ADMISSION)
