"""Records what the graph sends, images excepted, as it came over the wire. Bag time is the exposure stamp."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from hat_ros.errors import ConfigError
from hat_ros.io import topics
from hat_ros.io.bag_writer import BagWriter
from hat_ros.io.rosbag import stamp_of_cdr
from hat_ros.ros import process, qos
from hat_ros.ros.node import HatNode
from hat_ros.ros.session import Session


class RecorderSession(Session):
    """Writes every topic of :data:`~hat_ros.io.topics.RECORDED` into a bag.

    Attributes:
        counts: messages recorded by topic.
        newest_ns: stamp of the last message by topic.
        span_ns: stamps of the first and last admitted frame; nothing lies between (0, -1).
        writer: the result bag, open until :meth:`close`.
    """

    def __init__(self, node: HatNode[Session]) -> None:
        out = node.settings.extra["out"]
        if not out:
            raise ConfigError("parameter 'out' is empty: give the folder of the bag to write, -p out:=FOLDER")
        self.counts = dict.fromkeys(topics.RECORDED, 0)
        self.newest_ns = dict.fromkeys(topics.RECORDED, 0)
        self.span_ns = (0, -1)
        self.writer = BagWriter(Path(out))
        for topic in topics.RECORDED:
            profile = qos.RECORDER_LATCH if qos.is_latched(topic) else qos.RECORDER
            node.endpoints.input(topic, partial(self._on_message, topic), profile=profile, raw=True)

    def close(self) -> None:
        """Close the bag; it is complete and readable afterwards."""
        self.writer.close()

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics."""
        return dict(self.counts)

    def _on_message(self, topic: str, data: bytes) -> None:
        # Diagnostics carry the wall clock; in the bag they get the stamp of the newest frame.
        clocked = topic == topics.DIAGNOSTICS
        stamp_ns = self.newest_ns[topics.ADMISSION] if clocked else stamp_of_cdr(data, self.writer.path)
        self.writer.write_cdr(topic, topics.TYPES[topic], data, stamp_ns)
        self.counts[topic] += 1
        if topic == topics.ADMISSION:
            self.span_ns = (self.span_ns[0] if self.counts[topic] > 1 else stamp_ns, stamp_ns)
        self.newest_ns[topic] = max(self.newest_ns[topic], stamp_ns)


class RecorderNode(HatNode[RecorderSession]):
    """The node that writes the result bag."""

    NAME = "recorder"
    GOES_ON_LIVE = False
    EXTRA_PARAMETERS: ClassVar = {"out": ("", "folder of the bag to write")}

    def open_session(self) -> RecorderSession:
        """Open the bag and subscribe."""
        return RecorderSession(self)


def main() -> int:
    """Console script."""
    return process.main([RecorderNode])


if __name__ == "__main__":
    sys.exit(main())
