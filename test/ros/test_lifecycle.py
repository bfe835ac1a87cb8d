"""Lifecycle of a node, its diagnostics, and what the sources promise about truth and middleware."""

from __future__ import annotations

import ast
import logging
from pathlib import Path

import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn

import hat_ros
from hat_ros.config import config_from_dict
from hat_ros.errors import ConfigError, StageTimeoutError
from hat_ros.io import images, messages, topics
from hat_ros.ros import base, process
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
    process.close(executor, [node for node in executor.get_nodes() if isinstance(node, base.HatNode)])
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

    def configure(self):
        logging.getLogger("hat_ros.hypotheses.any").info("encoded %d of %d templates", 8, 162)
        self.text_meanwhile = self._text
        super().configure()


def test_long_preparations_show_in_diagnostics_while_they_last(executor, caplog):
    node = add(executor, PreparingNode)
    handlers = list(logging.getLogger("hat_ros").handlers)
    with caplog.at_level(logging.INFO, "hat_ros"):
        node.start()
    assert node.text_meanwhile == "busy: encoded 8 of 162 templates"
    assert node._text == "waiting for the other nodes"
    assert logging.getLogger("hat_ros").handlers == handlers


def test_a_node_that_says_something_new_is_not_given_up(executor, clean_bag):
    player = add(executor, PlayerNode, bag=str(clean_bag), config="default")
    player.start()
    progress = []
    for text in ("busy: 8 of 162", "busy: 8 of 162", "busy: 16 of 162"):
        player.progress_s = 0.0
        player._on_diagnostics(player.wire.diagnostics(0, "hat: hypotheses", base.OK, text, {}))
        progress.append(player.progress_s > 0.0)
    assert progress == [True, False, True]
    player.progress_s = 0.0
    with pytest.raises(StageTimeoutError, match=r"hypotheses: busy: 16 of 162.*raise graph\.startup_timeout_s"):
        player._feed()


def test_the_first_frame_has_the_longer_of_two_limits():
    limits = {"stage_timeout_s": 30.0, "startup_timeout_s": 180.0}
    config = config_from_dict({"graph": limits}).graph
    assert base.answer_limit(config, first=True) == (180.0, "graph.startup_timeout_s")
    assert base.answer_limit(config, first=False) == (30.0, "graph.stage_timeout_s")
    slow = config_from_dict({"graph": {**limits, "stage_timeout_s": 900.0}}).graph
    assert base.answer_limit(slow, first=True) == (900.0, "graph.stage_timeout_s")


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
        name: sender.create_publisher(messages.message_class(topics.TYPES[name]), name, base.qos.STAGE)
        for name in all_three
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
    node.guarded(node._on_item, topics.ADMISSION, messages.Wire.ros().table(5, "c", ("a",), [[1.0]]))
    node.guarded(node._on_item, topics.HYPOTHESES_SCORED, messages.Wire.ros().candidates(5, "c", Candidates.none()))
    node.guarded(node._on_item, topics.SLAM_STATE, messages.Wire.ros().motion(5, "c", Motion.none()))
    assert "table columns must be seq dropped_total epoch, found a" in str(node.failure)


def test_diagnostics_come_once_a_second_and_on_change(executor):
    node = add(executor, SelectorNode)
    seen = []
    listener = rclpy.create_node("listener", context=executor.context)
    executor.add_node(listener)
    listener.create_subscription(
        messages.message_class(topics.TYPES[topics.DIAGNOSTICS]), topics.DIAGNOSTICS, seen.append, base.qos.OUT
    )
    assert spin_until(executor, lambda: len(seen) >= 2, turns=400)
    before = len(seen)
    node.report(base.ERROR, "something new")
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
    assert not node.has_input(topics.FRAME)
    viewer = rclpy.create_node("viewer", context=executor.context)
    executor.add_node(viewer)
    seen = []

    def publisher(topic):
        return viewer.create_publisher(messages.message_class(topics.TYPES[topic]), topic, base.qos.profile_of(topic))

    send = {topic: publisher(topic) for topic in (topics.HAT_CAMERA_INFO, topics.FRAME, topics.STATUS)}
    subscription = viewer.create_subscription(
        messages.message_class(topics.TYPES[topics.OVERLAY]), topics.OVERLAY, seen.append, base.qos.DEBUG
    )
    assert spin_until(executor, lambda: node.has_input(topics.FRAME), turns=400)
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
    assert spin_until(executor, lambda: not node.has_input(topics.FRAME), turns=400)
    viewer.destroy_node()


# ------------------------------------------------------------------ what the sources promise


def sources():
    return [(path, ast.parse(path.read_text(encoding="utf-8"))) for path in PACKAGE.rglob("*.py")]


def imported(tree):
    for item in ast.walk(tree):
        if isinstance(item, ast.Import):
            yield from (alias.name for alias in item.names)
        elif isinstance(item, ast.ImportFrom) and item.module:
            yield item.module


def test_only_the_nodes_import_rclpy():
    for path, tree in sources():
        if path.parent.name != "ros":
            assert not any(name.split(".")[0] == "rclpy" for name in imported(tree)), path


def test_no_node_ever_names_the_truth():
    naming = {path.name for path, _ in sources() if "GROUND_TRUTH" in path.read_text() and path.parent.name == "ros"}
    assert naming == {"graph.py"}, "graph.py copies it from bag to record; no node subscribes or publishes"


def test_launch_files_compile_and_ship_what_they_name():
    launch = PACKAGE.parent / "launch" / "hat.launch.py"
    compile(launch.read_text(encoding="utf-8"), str(launch), "exec")
    for node in ("segmentation", "hypotheses", "slam", "selector", "fusion"):
        assert node in launch.read_text()
        assert (PACKAGE / "ros" / f"{node}_node.py").is_file()
