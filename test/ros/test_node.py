"""Lifecycle of a node, its diagnostics, and what it does with messages."""

from __future__ import annotations

import logging

import pytest
import rclpy
from rclpy.lifecycle import TransitionCallbackReturn
from single_node import add, spin_until

from hat_ros.errors import ConfigError, RunError
from hat_ros.io import messages, topics
from hat_ros.ros import qos
from hat_ros.ros.diagnostics import ERROR
from hat_ros.ros.joined_frames import JoinedFrames
from hat_ros.ros.selector_node import SelectorNode
from hat_ros.ros.slam_node import SlamNode
from hat_ros.types import Candidates, Motion


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
    assert f"table columns must be {' '.join(topics.ADMISSION_COLUMNS)}, found a" in str(node.failure)


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
