"""What is used of ``rosbags``: its message classes and its reader, with one error for all that damaged bytes cause."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from hat_ros.errors import BagError, HatError

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)


@contextmanager
def opened_bag(path: Path) -> Iterator[Reader]:
    """The reader of a rosbag2 folder or MCAP file.

    Raises:
        BagError: no bag, damaged, or compressed as a whole; also for what goes wrong while the context lasts.
    """
    with damage_as_bag_error(path), Reader(path) as reader:
        if reader.compression_mode:
            raise BagError(
                f"{path} is compressed by {reader.compression_mode}: record it without, or convert it with "
                f"`ros2 bag convert` (compression inside MCAP chunks is fine)"
            )
        yield reader


def deserialize(data: bytes, kind: str, where: Path) -> Any:
    """A message from its CDR bytes.

    Raises:
        BagError: the bytes are not a message of this type.
    """
    with damage_as_bag_error(where):
        return TYPESTORE.deserialize_cdr(data, kind)


def stamp_of_cdr(data: bytes, where: Path) -> int:
    """Stamp in nanoseconds of a serialized message that starts with a std_msgs/Header (CDR, either byte order).

    Raises:
        BagError: the bytes are no CDR or too short.
    """
    if len(data) < 12 or data[0] != 0 or data[1] not in (0, 1):
        raise BagError(f"{where}: a message is not CDR or too short for a header ({len(data)} bytes)")
    little = data[1] == 1
    sec = int.from_bytes(data[4:8], "little" if little else "big", signed=True)
    return sec * 1_000_000_000 + int.from_bytes(data[8:12], "little" if little else "big")


@contextmanager
def damage_as_bag_error(where: Path) -> Iterator[None]:
    """Whatever a parser of foreign bytes raises means one thing: the bag is damaged."""
    try:
        yield
    except HatError:
        raise
    except Exception as error:  # struct, YAML, sqlite, zstd, lz4 and assertion errors alike
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise BagError(f"{where} is damaged or no bag: {reason}; record or copy it again") from None
