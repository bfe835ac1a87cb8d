"""The files of a bag as one stream of messages: MCAP, sqlite3 or ROS 1, one or many, compressed or not.

Of ``metadata.yaml`` only the list of files is used. Topics, types and counts come from the storage itself, so a bag is
read without it, and whatever was edited in it (QoS, storage identifier, counts) does not matter.
"""

from __future__ import annotations

import heapq
import io
import os
import re
import shutil
import tempfile
import weakref
from collections.abc import Collection, Generator, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path, PurePath
from typing import BinaryIO, Protocol

import yaml
import zstandard
from mcap.reader import McapReader, NonSeekingReader, make_reader
from rosbags.rosbag2 import Reader

from hat_ros.errors import BagError
from hat_ros.io.damage import damage_as_bag_error
from hat_ros.io.integrity import MAX_CHUNK_BYTES, check_mcap
from hat_ros.io.ros1 import convert_ros1

METADATA_FILE = "metadata.yaml"
# What lies in a bag's folder under these names is read.
STORAGE_SUFFIXES = (".mcap", ".db3")

_MAX_METADATA_BYTES = 16 * 2**20
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_CDR = "cdr"
_ROS1_SUFFIX = ".bag"
# A compressed file grows by this factor at most, or to this size: dark images compress well, bombs better.
_MAX_GROWTH, _MAX_SMALL_BYTES = 200, 2**30
_BLOCK_BYTES = 2**20


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: its name.
        kind: message type, ``package/msg/Name``.
        count: its messages.
    """

    name: str
    kind: str
    count: int


@dataclass(frozen=True)
class Recorded:
    """One recorded message: its topic and type, the bag's time, and the CDR bytes."""

    topic: str
    kind: str
    log_ns: int
    data: bytes


class _Storage(Protocol):
    """One file of a bag."""

    def topics(self) -> list[Topic]:
        """What it holds in CDR; topics of another encoding (JSON, protobuf) are left out."""
        ...

    def messages(self, names: Collection[str]) -> Iterator[Recorded]:
        """The messages of these topics in the order of their bag time."""
        ...


class BagFiles:
    """The messages of a bag.

    Args:
        path: a bag's folder, with or without ``metadata.yaml``, or one file of it.

    Attributes:
        topics: name -> topic of everything in it that is CDR.

    Raises:
        BagError: there is no bag, or it is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        files = bag_files(path)
        scratch = path
        if any(file.suffix in (".zstd", _ROS1_SUFFIX) for file in files):
            # What is unpacked or converted first lies there, and goes with this object.
            scratch = Path(tempfile.mkdtemp(prefix="hat_bag_"))
            weakref.finalize(self, shutil.rmtree, scratch, ignore_errors=True)
        self._storages = [_storage(file, scratch) for file in files]
        self.topics: dict[str, Topic] = {}
        with damage_as_bag_error(path):
            for topic in (topic for storage in self._storages for topic in storage.topics()):
                before = self.topics.get(topic.name)
                self.topics[topic.name] = topic if before is None else replace(topic, count=topic.count + before.count)

    def messages(self, names: Collection[str]) -> Iterator[Recorded]:
        """The messages of these topics in the order of their bag time, over all files.

        Raises:
            BagError: a file is damaged.
        """
        with damage_as_bag_error(self._path), ExitStack() as stack:
            streams = [stack.enter_context(closing(_plain(storage.messages(names)))) for storage in self._storages]
            yield from heapq.merge(*streams, key=attrgetter("log_ns"))


def _storage(file: Path, scratch: Path) -> _Storage:
    if file.suffix == ".zstd":
        file = _unpacked(file, scratch / file.stem)
    if file.suffix == _ROS1_SUFFIX:
        file = convert_ros1(file, scratch)
    if file.suffix == ".mcap":
        check_mcap(file)
        return _Mcap(file)
    return _Sqlite(file)


def bag_files(path: Path) -> list[Path]:
    """The files of a bag, in order.

    Raises:
        BagError: there is none, or one that ``metadata.yaml`` lists is missing.
    """
    if not path.exists():
        raise BagError(f"bag {path} does not exist")
    found = [path] if path.is_file() else _listed(path) or _lying(path)
    if not found and path.is_dir():
        found = _ros1_in(path)
    if not found:
        raise BagError(f"{path} is no bag: it has neither {METADATA_FILE} nor a file {' or '.join(STORAGE_SUFFIXES)}")
    for file in found:
        if not os.path.isfile(file):  # Path.is_file raises for names that are too long
            raise BagError(f"{path} lacks {file.name}, which its {METADATA_FILE} lists: copy the bag again")
        if not _is_storage(file) and file.suffix != _ROS1_SUFFIX:
            raise BagError(f"{file} is no file of a bag: they end in {' or '.join(STORAGE_SUFFIXES)}")
    return found


def is_bag(path: Path) -> bool:
    """Whether there is something that calls itself a bag: ``metadata.yaml`` or a storage file."""
    if path.is_file():
        return _is_storage(path) or path.suffix == _ROS1_SUFFIX
    return (path / METADATA_FILE).is_file() or any(_lying(path)) or any(_ros1_in(path))


def _is_storage(file: Path) -> bool:
    return Path(file.name.removesuffix(".zstd")).suffix in STORAGE_SUFFIXES


def _lying(folder: Path) -> list[Path]:
    """What lies in a folder, ``x_2`` before ``x_10``."""
    found = [file for file in folder.iterdir() if file.is_file() and _is_storage(file)]
    return sorted(found, key=lambda file: [part.zfill(20) for part in re.split(r"(\d+)", file.name)])


def _ros1_in(folder: Path) -> list[Path]:
    return sorted(file for file in folder.glob(f"*{_ROS1_SUFFIX}") if file.is_file())


def _listed(folder: Path) -> list[Path]:
    """What ``metadata.yaml`` lists; nothing where there is none."""
    path = folder / METADATA_FILE
    if not path.is_file():
        return []
    if path.stat().st_size > _MAX_METADATA_BYTES:
        raise BagError(f"{path} is larger than {_MAX_METADATA_BYTES // 2**20} MiB")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        names = [PurePath(str(name)).name for name in content["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError, RecursionError):
        raise BagError(f"{path} is damaged: delete it, the bag's files are read without it") from None
    # Of a bag compressed as a whole, some versions list the names before compression.
    return [folder / name if os.path.exists(folder / name) else _with_zstd(folder / name) for name in names]


def _with_zstd(file: Path) -> Path:
    packed = file.with_name(f"{file.name}.zstd")
    return packed if os.path.exists(packed) else file


def _unpacked(file: Path, out: Path) -> Path:
    limit = max(_MAX_SMALL_BYTES, _MAX_GROWTH * file.stat().st_size)
    with damage_as_bag_error(file), file.open("rb") as packed, out.open("wb") as plain:
        for block in _inflated(packed):
            plain.write(block)
            if plain.tell() > limit:
                raise BagError(f"{file} unpacks to more than {limit} bytes: refused")
    return out


def _inflated(packed: BinaryIO) -> Iterator[bytes]:
    reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
    while block := reader.read(_BLOCK_BYTES):
        yield block


def _plain(messages: Iterator[Recorded]) -> Generator[Recorded, None, None]:
    """Undo the compression of single messages, which is known by zstd's own mark: CDR begins with a zero."""
    for message in messages:
        yield replace(message, data=_inflated_message(message)) if message.data[:4] == _ZSTD_MAGIC else message


def _inflated_message(message: Recorded) -> bytes:
    out = bytearray()
    for block in _inflated(io.BytesIO(message.data)):
        out += block
        if len(out) > MAX_CHUNK_BYTES:
            raise BagError(f"a message on {message.topic} unpacks to more than {MAX_CHUNK_BYTES} bytes: refused")
    return bytes(out)


class _Mcap:
    """An MCAP file; read by its index if that is complete, else from beginning to end."""

    def __init__(self, file: Path) -> None:
        self._file = file

    def topics(self) -> list[Topic]:
        with self._file.open("rb") as stream:
            reader = make_reader(stream)
            summary = reader.get_summary()
            if summary is not None and summary.statistics is not None and _is_indexed(reader):
                counts = summary.statistics.channel_message_counts
                kinds = {number: schema.name for number, schema in summary.schemas.items()}
                return [
                    Topic(channel.topic, kinds.get(channel.schema_id, ""), counts.get(number, 0))
                    for number, channel in summary.channels.items()
                    if channel.message_encoding == _CDR
                ]
        topics: dict[str, Topic] = {}
        for message in self.messages(()):
            before = topics.get(message.topic) or Topic(message.topic, message.kind, 0)
            topics[message.topic] = replace(before, count=before.count + 1)
        return list(topics.values())

    def messages(self, names: Collection[str]) -> Iterator[Recorded]:
        """As in the protocol; of no names, the messages of all topics."""
        with self._file.open("rb") as stream:
            reader = make_reader(stream)
            by_index = _is_indexed(reader)
            if not by_index:
                stream.seek(0)
                reader = NonSeekingReader(stream)
            for schema, channel, message in reader.iter_messages(list(names) or None, log_time_order=by_index):
                if channel.message_encoding == _CDR and schema is not None:
                    yield Recorded(channel.topic, schema.name, message.log_time, message.data)


def _is_indexed(reader: McapReader) -> bool:
    """The summary names every channel and schema that its chunks use."""
    summary = reader.get_summary()
    if summary is None or not summary.chunk_indexes:
        return False
    used = {number for chunk in summary.chunk_indexes for number in chunk.message_index_offsets}
    schemas = {channel.schema_id for channel in summary.channels.values()} - {0}
    return used <= summary.channels.keys() and schemas <= summary.schemas.keys()


class _Sqlite:
    """A sqlite3 file."""

    def __init__(self, file: Path) -> None:
        self._file = file

    def topics(self) -> list[Topic]:
        with Reader(self._file) as reader:
            return [Topic(c.topic, c.msgtype, c.msgcount) for c in reader.connections]

    def messages(self, names: Collection[str]) -> Iterator[Recorded]:
        with Reader(self._file) as reader:
            wanted = [connection for connection in reader.connections if connection.topic in names]
            if wanted:  # of no connections, the reader gives the messages of all
                for connection, log_ns, data in reader.messages(connections=wanted):
                    yield Recorded(connection.topic, connection.msgtype, log_ns, bytes(data))
