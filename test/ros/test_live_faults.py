"""Faults of a live graph: what each of them costs, and that poses come again."""

from __future__ import annotations

import re
import time
from functools import partial

import pytest
from live_nodes import KINDS, Camera, LiveNodes
from rclpy.lifecycle import TransitionCallbackReturn
from single_node import spin_until

from hat_ros.errors import FrameError
from hat_ros.io import topics
from hat_ros.io.messages import message_class
from hat_ros.ros import qos
from hat_ros.ros.diagnostics import OK, STALE, WARN
from hat_ros.types import TrackState

pytestmark = pytest.mark.graph

# No fault of these tests may be found by waiting for so long.
PATIENT = {"graph.live_timeout_s": 30.0}
# Those of one stage are in every run of the tests, those of the others on request.
LIVE = (pytest.mark.slow, pytest.mark.live)
NODES = ("slam", *(pytest.param(name, marks=LIVE) for name in KINDS if name != "slam"))
STAGES = ("slam", *(pytest.param(name, marks=LIVE) for name in KINDS if name not in ("slam", "segmentation")))


@pytest.fixture
def started(executor, clean_bag):
    graphs = []

    def start(**changed):
        graphs.append(LiveNodes(executor, clean_bag, **changed))
        graphs[-1].await_ready()
        graphs[-1].calibrate()
        return graphs[-1]

    yield start
    for graph in graphs:
        graph.close()


def posed(estimates):
    return [estimate.state.has_pose for estimate in estimates]


def once(publisher, monkeypatch):
    """The next message of a publisher is lost."""
    publish = publisher.publish

    def lose(message):
        monkeypatch.setattr(publisher, "publish", publish)

    monkeypatch.setattr(publisher, "publish", lose)


def test_a_lost_message_costs_its_frame_and_nothing_else(started, monkeypatch):
    graph = started(**{"graph.live_timeout_s": 2.0})
    before = graph.send(6)
    assert posed(before)[-1]
    sessions = {name: node.session for name, node in graph.nodes.items()}
    lossy = {
        "hypotheses": sessions["hypotheses"]._scored,
        "slam": sessions["slam"]._state,
        "selector": sessions["selector"]._selection,
        "fusion": sessions["fusion"]._status,
        "segmentation": sessions["segmentation"]._frame,
    }
    for n, publisher in enumerate(lossy.values(), 1):
        once(publisher, monkeypatch)
        graph.send_into_void()
        began = time.monotonic()
        after = graph.send(2)  # the first of them waits until the lost one is given up
        assert time.monotonic() - began > 1.9
        assert posed(after) == [True, True]
        assert after[-1].slam_epoch == before[-1].slam_epoch, "nothing begins anew"
        assert sessions["segmentation"]._in_flight.given_up >= n
    assert [node.failure for node in graph.nodes.values()] == [None] * 5
    assert sessions["fusion"].values()["lost"] == 4, "all but the status, which is its own"


def test_a_stage_that_fails_gives_its_frame_up_at_once(started, monkeypatch):
    graph = started(**PATIENT)
    graph.send(4)
    slam = graph.nodes["slam"].session

    def fail(joined):
        monkeypatch.undo()
        raise FrameError("no motion here")

    monkeypatch.setattr(slam, "step", fail)
    graph.send_into_void()
    assert posed(graph.send(4))[-1]
    assert graph.nodes["slam"].failure is None
    assert graph.entrance.session._in_flight.given_up == 1


@pytest.mark.parametrize("name", STAGES)
def test_a_stage_that_starts_again_ends_the_wait_at_once(started, name):
    graph = started(**PATIENT)
    assert posed(graph.send(4))[-1]
    confirmed = graph.send(1)[0].state.is_confirmed
    graph.kill(name)
    graph.send_into_void()
    graph.start(name)
    graph.await_ready()
    after = graph.send(4)
    assert posed(after)[-1]
    assert confirmed
    assert TrackState.INITIALISING not in [estimate.state for estimate in after], "the target was not lost"


def test_the_entrance_starts_again(started):
    graph = started(**PATIENT)
    assert posed(graph.send(4))[-1]
    graph.kill("segmentation")
    graph.start("segmentation")
    graph.await_ready()
    graph.calibrate()
    assert posed(graph.send(4))[-1]


def go(node, *transitions):
    for transition in transitions:
        assert getattr(node, f"trigger_{transition}")() == TransitionCallbackReturn.SUCCESS, transition


@pytest.mark.parametrize("name", NODES)
def test_lifecycle_transitions_of_one_node_stop_the_graph_only_meanwhile(started, name):
    graph = started(**PATIENT)
    node = graph.nodes[name]
    assert posed(graph.send(4))[-1]
    for down, up in ((("deactivate",), ("activate",)), (("deactivate", "cleanup"), ("configure", "activate"))):
        go(node, *down)
        spin_until(graph.executor, lambda: False, turns=10)
        if name != "segmentation":
            assert not graph.entrance.session._is_open
        go(node, *up)
        graph.await_ready()
        graph.calibrate()
        assert posed(graph.send(5))[-1], (name, up)


def test_a_manager_may_bring_the_nodes_up_in_any_order(executor, clean_bag):
    graph = LiveNodes(executor, clean_bag, autostart=False, **PATIENT)
    nodes = graph.nodes
    go(nodes["segmentation"], "configure", "activate")
    go(nodes["slam"], "configure")
    spin_until(executor, lambda: False, turns=10)
    go(nodes["slam"], "cleanup", "configure", "activate")
    for name in ("fusion", "selector", "hypotheses"):
        go(nodes[name], "configure")
        spin_until(executor, lambda: False, turns=10)
    for name in ("hypotheses", "fusion", "selector"):
        go(nodes[name], "activate")
    graph.await_ready()
    graph.calibrate()
    assert posed(graph.send(5))[-1]
    # Active at once, with what is latched already on its way.
    go(nodes["hypotheses"], "deactivate", "cleanup", "configure")
    spin_until(executor, lambda: False, turns=25)
    go(nodes["hypotheses"], "activate")
    graph.await_ready()
    assert posed(graph.send(5))[-1]
    go(nodes["slam"], "shutdown")
    assert spin_until(executor, lambda: not graph.entrance.session._is_open)
    graph.close()


def test_a_stamp_far_ahead_and_a_reset(started):
    graph = started(**PATIENT)
    assert posed(graph.send(5))[-1]
    ahead, back = 3600 * 10**9, graph.stamp_ns
    graph.stamp_ns += ahead
    graph.send()
    graph.stamp_ns = back
    for _ in range(4):
        refused, frame = graph.entrance.values()["refused"], graph.next_frame()
        graph.camera.send(frame, lambda n=refused: graph.entrance.values()["refused"] == n + 1, graph.stamp_ns)
    assert posed(graph.send(5))[-1], "the fifth begins a new epoch"

    graph.stamp_ns += ahead
    graph.send()
    graph.stamp_ns = back + 100 * 10**6
    graph.entrance.session._on_reset(None, type("Response", (), {})())
    estimates = graph.send(5)
    assert posed(estimates)[-1], "none is refused after a reset"
    assert estimates[-1].state in (TrackState.TRACKING, TrackState.COASTING)


def diagnosed(graph):
    return graph.entrance.diagnostics.level, graph.entrance.diagnostics.text


def camera_of(graph, profile):
    graph.camera.node.destroy_node()
    graph.camera = Camera(graph.executor, profile)


def follows(graph, profile):
    session = graph.entrance.session
    profiles = [followed._profile for followed in (session._images, session._infos)]
    return all(found is not None and found.reliability == profile.reliability for found in profiles)


def test_the_input_follows_the_camera(executor, clean_bag):
    graph = LiveNodes(executor, clean_bag, **PATIENT)
    graph.camera.node.destroy_node()
    assert spin_until(executor, lambda: diagnosed(graph) == (WARN, "no camera on /image or /image/compressed"), 500)
    best_effort = qos.DEBUG
    for profile in (best_effort, qos.IN_REPLAY, best_effort):
        camera_of(graph, profile)
        assert spin_until(executor, partial(follows, graph, profile), turns=500)
        graph.await_ready()
        graph.calibrate()
        assert posed(graph.send(4))[-1]
    compressed = graph.camera.node.create_publisher(
        message_class(topics.TYPES[topics.IMAGE_COMPRESSED]), topics.IMAGE_COMPRESSED, best_effort
    )
    spin_until(executor, lambda: False, turns=60)
    assert compressed.get_subscription_count() == 0, "one transport, chosen once"
    assert graph.entrance.values()["dropped"] == 0
    assert spin_until(executor, lambda: diagnosed(graph)[0] == STALE, turns=500)
    assert re.fullmatch(r"no image for [5-9]\.\d s on /image", diagnosed(graph)[1])
    assert posed(graph.send(2))[-1]
    assert spin_until(executor, lambda: diagnosed(graph)[0] == OK)
    graph.close()


def test_a_transport_that_is_asked_for_is_the_only_one(executor, clean_bag):
    graph = LiveNodes(executor, clean_bag, **{"camera.transport": "compressed"})
    assert spin_until(executor, lambda: diagnosed(graph) == (WARN, "no camera on /image/compressed"), turns=500)
    assert graph.camera.image.get_subscription_count() == 0
    graph.close()
