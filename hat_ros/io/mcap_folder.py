"""Writes the rosbag2 format: a folder with one MCAP file (zstd chunks, with checksums) and ``metadata.yaml``.

Formats: https://mcap.dev/spec (records), https://mcap.dev/spec/registry#ros2 (profile), and version 9 of rosbag2's
``metadata.yaml``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import yaml
from mcap.writer import CompressionType, Writer

from hat_ros.io.reserved_file import ReservedFile
from hat_ros.io.rosbag import TYPESTORE

_METADATA_VERSION = 9


@dataclass
class _Channel:
    """One topic of the file."""

    number: int
    kind: str
    type_hash: str
    count: int = 0


class McapFolder:
    """A rosbag2 folder that grows message by message; complete and readable after :meth:`close`.

    Args:
        path: folder to create; its MCAP file has the same name.

    Raises:
        OSError: the folder exists or cannot be written; also from the methods.
    """

    def __init__(self, path: Path) -> None:
        path.mkdir(parents=True)
        self._path = path
        self._file = ReservedFile(path / f"{path.name}.mcap")
        # Of a stream, the writer needs write(), tell() and flush().
        self._writer = Writer(cast("IO[bytes]", self._file), compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="hat_ros")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, _Channel] = {}
        self._first_ns = self._last_ns = 0

    @property
    def is_full(self) -> bool:
        """The disk is full: what was written so far can still be closed in good order, and nothing more added."""
        return self._file.is_full

    def write(self, topic: str, kind: str, data: bytes, log_ns: int) -> None:
        """Append a message.

        Args:
            topic: its topic.
            kind: its type, ``package/msg/Name``, one of the types of ROS 2 Jazzy.
            data: the message as CDR.
            log_ns: bag time, not negative.
        """
        channel = self._channels.get(topic) or self._add_channel(topic, kind)
        self._first_ns = min(self._first_ns, log_ns) if self._count else log_ns
        self._last_ns = max(self._last_ns, log_ns)
        self._writer.add_message(channel.number, log_ns, data, publish_time=log_ns)
        channel.count += 1

    def _add_channel(self, topic: str, kind: str) -> _Channel:
        if kind not in self._schemas:
            definition, _ = TYPESTORE.generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition.encode())
        number = self._writer.register_channel(topic, "cdr", self._schemas[kind], {"offered_qos_profiles": ""})
        self._channels[topic] = _Channel(number, kind, TYPESTORE.hash_rihs01(kind))
        return self._channels[topic]

    @property
    def _count(self) -> int:
        return sum(channel.count for channel in self._channels.values())

    def close(self) -> None:
        """Write index and metadata. Once."""
        content = self._metadata()
        self._writer.add_metadata("rosbag2", {"serialized_metadata": yaml.safe_dump(content, sort_keys=False)})
        self._writer.finish()
        self._file.close()
        text = yaml.safe_dump({"rosbag2_bagfile_information": content}, sort_keys=False)
        (self._path / "metadata.yaml").write_text(text, encoding="utf-8")

    def _metadata(self) -> dict[str, Any]:
        name = f"{self._path.name}.mcap"
        when = {
            "starting_time": {"nanoseconds_since_epoch": self._first_ns},
            "duration": {"nanoseconds": self._last_ns - self._first_ns},
            "message_count": self._count,
        }
        return {
            "version": _METADATA_VERSION,
            "storage_identifier": "mcap",
            "relative_file_paths": [name],
            **when,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic,
                        "type": channel.kind,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": [],
                        "type_description_hash": channel.type_hash,
                    },
                    "message_count": channel.count,
                }
                for topic, channel in self._channels.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": name, **when}],
            "custom_data": None,
            "ros_distro": "jazzy",
        }
