"""Two graphs side by side: each in its namespace, and nothing of one is heard in the other."""

from __future__ import annotations

import pytest
import rclpy
from live_nodes import KINDS, WIRE, parameters
from rclpy.executors import SingleThreadedExecutor
from single_node import add, spin_until

from hat_ros.io import messages, topics
from hat_ros.io.bag_reader import BagReader
from hat_ros.ros import process, qos
from hat_ros.ros.node import HatNode

pytestmark = pytest.mark.graph


class Side:
    """A graph and a camera in one namespace, in a context of its own."""

    def __init__(self, bag, namespace):
        self.context = rclpy.Context()
        rclpy.init(args=["--ros-args", "-r", f"__ns:={namespace}"], context=self.context, domain_id=117)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.nodes = {name: add(self.executor, kind, **parameters(bag)) for name, kind in KINDS.items()}
        for node in self.nodes.values():
            node.start()
        self.camera = rclpy.create_node("camera", context=self.context)
        self.executor.add_node(self.camera)
        self.statuses, self.diagnosed = [], set()
        self.image, self.info = (
            self.camera.create_publisher(
                messages.message_class(topics.TYPES[topic]), topics.relative(topic), qos.IN_REPLAY
            )
            for topic in (topics.IMAGE, topics.CAMERA_INFO)
        )
        for topic, heard in ((topics.STATUS, self.statuses.append), (topics.DIAGNOSTICS, self._on_diagnostics)):
            kind = messages.message_class(topics.TYPES[topic])
            self.camera.create_subscription(kind, topics.relative(topic), heard, qos.profile_of(topic))

    def _on_diagnostics(self, message):
        self.diagnosed |= {status.name for status in message.status}

    @property
    def is_open(self):
        return self.nodes["segmentation"].session._is_open

    def close(self):
        self.camera.destroy_node()
        process.close(self.executor, [node for node in self.executor.get_nodes() if isinstance(node, HatNode)])
        self.context.try_shutdown()


@pytest.fixture
def sides(clean_bag):
    both = [Side(clean_bag, namespace) for namespace in ("/cam1", "/cam2")]
    yield both
    for side in both:
        side.close()


def test_two_graphs_on_one_domain_do_not_hear_each_other(sides, clean_bag):
    frames, first = list(BagReader(clean_bag).frames()), sides[0]

    def both(condition):
        def turn():
            sides[1].executor.spin_once(timeout_sec=0.01)
            return condition()

        return spin_until(first.executor, turn, turns=2000)

    assert both(lambda: all(side.is_open for side in sides))
    assert both(lambda: all(p.get_subscription_count() == 1 for side in sides for p in (side.image, side.info)))
    for side in sides:
        side.info.publish(WIRE.camera_info(frames[0].stamp_ns, "cam", frames[0].camera))
    for index in range(4):
        for number, side in enumerate(sides):
            stamp_ns = frames[index].stamp_ns + number
            side.image.publish(WIRE.image(stamp_ns, "cam", "rgb8", frames[index].rgb))
        assert both(lambda index=index: all(len(side.statuses) == index + 1 for side in sides))
    for number, side in enumerate(sides):
        assert [messages.stamp_of(status) - number for status in side.statuses] == [f.stamp_ns for f in frames[:4]]
        assert side.nodes["segmentation"].values()["dropped"] == 0
    names = {f"hat: cam{number}/{name}" for number in (1, 2) for name in KINDS}
    assert both(lambda: first.diagnosed >= names)
    assert first.diagnosed == names, "one place for all diagnostics, and the namespace tells them apart"
    own = {name for name, _ in first.camera.get_topic_names_and_types()}
    assert {"/cam1/hat/status", "/cam2/hat/status", "/cam1/target_pose", topics.DIAGNOSTICS} <= own
    assert not [name for name in own if name.startswith("/hat/")]
