"""A graph told where the target is: live on a topic, in a replay by its configuration."""

import numpy as np
import pytest
from graph_clip import run_in_process, said
from live_nodes import WIRE, LiveNodes
from single_node import spin_until
from two_craft import as_text, craft_at, write_two_craft

from hat_ros.config import load_config
from hat_ros.core.initial_pose import InitialPose
from hat_ros.geometry import lie
from hat_ros.io import messages, topics
from hat_ros.ros import qos
from hat_ros.ros.graph import replay
from hat_ros.target.loading import load_target
from hat_ros.tracker import HatTracker
from hat_ros.types import Frame

N_FRAMES = 7
PLACE = as_text(lie.transform(np.eye(3), craft_at(1, 0)[:3, 3]), (0.1, -0.1, 0.5))
OVERRIDES = (
    "hypotheses.template.n_views=162",
    "keyframes.gap_frames=3",
    f"initial_pose.pose={PLACE}",
    "initial_pose.sigma=0.2 0.2 1 3 3 3",
)


@pytest.mark.graph
def test_live_the_craft_that_navigation_means_is_tracked_with_the_bytes_of_one_process(executor, tmp_path):
    bag = write_two_craft(tmp_path / "bag", 4)
    config = load_config("default", OVERRIDES)
    graph = LiveNodes(executor, bag)
    kind = messages.message_class(topics.TYPES[topics.INITIAL_POSE])
    publisher = graph.camera.node.create_publisher(kind, topics.INITIAL_POSE, qos.OUT)
    taken = []
    graph.camera.node.create_subscription(kind, topics.GIVEN_POSE, taken.append, qos.STAGE)
    graph.await_ready()
    graph.calibrate()
    assert spin_until(executor, publisher.get_subscription_count)
    given, refused = InitialPose.of(config), []
    graph.entrance.session._warn = refused.append

    def send(frame_id, covariance=given.covariance):
        publisher.publish(WIRE.pose_with_covariance(5, frame_id, given.pose_row, covariance))

    send("cam", np.zeros((6, 6)))  # the entrance has it, and no pose waits because of it
    assert spin_until(executor, lambda: len(refused) == 1)
    assert "positive definite" in refused[0]
    send("cam")
    assert spin_until(executor, lambda: graph.entrance.session._given is not None)
    found = graph.send(N_FRAMES)

    tracker = HatTracker(config, load_target(bag / "target.yaml"))
    for estimate in found:
        place = 1 + (estimate.stamp_ns - found[0].stamp_ns) // (found[1].stamp_ns - found[0].stamp_ns)
        place %= 2 * len(graph.frames) - 2
        frame = graph.frames[place if place < len(graph.frames) else 2 * len(graph.frames) - 2 - place]
        expected = tracker.step(Frame(estimate.stamp_ns, frame.rgb, frame.camera)).estimate
        assert estimate.state == expected.state
        assert np.array_equal(estimate.pose_row, expected.pose_row, equal_nan=True)
        assert np.linalg.norm(estimate.pose_row[:3] - craft_at(1, 0)[:3, 3]) < 0.2
    assert spin_until(executor, lambda: len(taken) == 1)
    assert messages.stamp_of(taken[0]) == found[0].stamp_ns

    send("elsewhere")
    assert spin_until(executor, lambda: graph.entrance.session._given is not None)
    graph.send(1)
    assert "it is in frame 'elsewhere', the images are in 'cam'" in refused[-1]
    assert [node.failure for node in graph.nodes.values()] == [None] * 5
    graph.close()


@pytest.mark.graph
def test_a_replay_goes_by_the_initial_pose_of_the_configuration(tmp_path):
    bag = write_two_craft(tmp_path / "bag", N_FRAMES)
    config = load_config("default", OVERRIDES)
    expected = run_in_process(bag, config, tmp_path / "one")
    replay(bag, config, bag / "target.yaml", tmp_path / "graph", graph="single")
    found = said(tmp_path / "graph")
    assert len(expected[topics.TARGET_POSE]) == N_FRAMES
    for topic, payload in expected.items():
        assert found[topic] == payload, topic
    positions = np.array([np.frombuffer(payload)[:3] for _, _, payload in found[topics.TARGET_POSE]])
    assert np.linalg.norm(positions - craft_at(1, 0)[:3, 3], axis=1).max() < 0.2
