"""A live graph in this process, and a camera that sends frame by frame."""

from __future__ import annotations

import rclpy
from graph_clip import CONFIG_OVERRIDES, FIRST_NS, STEP_NS
from single_node import add, spin_until

from hat_ros.io import messages, topics
from hat_ros.io.bag_reader import BagReader
from hat_ros.ros import qos
from hat_ros.ros.fusion_node import FusionNode
from hat_ros.ros.hypotheses_node import HypothesesNode
from hat_ros.ros.segmentation_node import SegmentationNode
from hat_ros.ros.selector_node import SelectorNode
from hat_ros.ros.slam_node import SlamNode

WIRE = messages.Wire.ros()
KINDS = {
    "segmentation": SegmentationNode,
    "hypotheses": HypothesesNode,
    "slam": SlamNode,
    "selector": SelectorNode,
    "fusion": FusionNode,
}


def parameters(bag):
    pairs = dict(item.split("=") for item in CONFIG_OVERRIDES)
    return {name: int(value) for name, value in pairs.items()} | {"target": str(bag / "target.yaml"), "live": True}


class Camera:
    """Sends frame by frame; the next one only after the answer to the one before."""

    def __init__(self, executor, profile=qos.IN_REPLAY):
        self.executor, self.node = executor, rclpy.create_node("camera", context=executor.context)
        executor.add_node(self.node)
        self.statuses, self.poses = [], []
        make = self.node.create_publisher
        self.image = make(messages.message_class(topics.TYPES[topics.IMAGE]), topics.IMAGE, profile)
        self.info = make(messages.message_class(topics.TYPES[topics.CAMERA_INFO]), topics.CAMERA_INFO, profile)
        for topic, out in ((topics.STATUS, self.statuses), (topics.TARGET_POSE, self.poses)):
            kind, profile = messages.message_class(topics.TYPES[topic]), qos.profile_of(topic)
            self.node.create_subscription(kind, topic, out.append, profile)

    def send(self, frame, done, stamp_ns=None):
        self.image.publish(WIRE.image(stamp_ns or frame.stamp_ns, "cam", "rgb8", frame.rgb))
        assert spin_until(self.executor, done, turns=3000)


class LiveNodes:
    """Five live nodes and their camera, ready for frames; the clip goes forth and back.

    Attributes:
        nodes: by name.
        stamp_ns: of the newest frame sent.
    """

    def __init__(self, executor, bag, **changed):
        self.executor, self.parameters = executor, parameters(bag) | changed
        self.frames = list(BagReader(bag).frames())
        self.nodes = {name: add(executor, kind, **self.parameters) for name, kind in KINDS.items()}
        if self.parameters.get("autostart", True):
            for node in self.nodes.values():
                node.start()
        self.camera = Camera(executor)
        self.n_sent, self.stamp_ns = 0, FIRST_NS

    @property
    def entrance(self):
        return self.nodes["segmentation"]

    def await_ready(self):
        def ready():
            heard = self.camera.image.get_subscription_count() and self.camera.info.get_subscription_count()
            return heard and self.entrance.session._is_open

        assert spin_until(self.executor, ready, turns=3000)

    def calibrate(self):
        self.camera.info.publish(WIRE.camera_info(self.stamp_ns, "cam", self.frames[0].camera))
        assert spin_until(self.executor, lambda: self.entrance.session._entrance.is_calibrated)

    def next_frame(self):
        self.n_sent += 1
        self.stamp_ns += STEP_NS
        place = self.n_sent % (2 * len(self.frames) - 2)
        return self.frames[place if place < len(self.frames) else 2 * len(self.frames) - 2 - place]

    def send(self, n=1):
        """Send frames and wait for each answer; the estimates."""
        out = []
        for _ in range(n):
            frame, before = self.next_frame(), len(self.camera.statuses)
            self.camera.send(frame, lambda before=before: len(self.camera.statuses) > before, self.stamp_ns)
            out.append(messages.status_from(self.camera.statuses[-1]).estimate)
            assert out[-1].stamp_ns == self.stamp_ns
        return out

    def send_into_void(self):
        """Send a frame that is admitted and will not be answered."""
        admitted, frame = self.entrance.values()["admitted"], self.next_frame()
        self.camera.send(frame, lambda: self.entrance.values()["admitted"] == admitted + 1, self.stamp_ns)

    def kill(self, name):
        """End a node without a word."""
        old = self.nodes.pop(name)
        old._announced = False  # a killed process says nothing
        self.executor.remove_node(old)
        old.release()
        old.destroy_node()

    def start(self, name):
        """Start a node anew."""
        self.nodes[name] = add(self.executor, KINDS[name], **self.parameters)
        self.nodes[name].start()

    def close(self):
        self.camera.node.destroy_node()
