"""What is used of ``rosbags``' type system: message classes from CDR bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_typestore

from hat_ros.errors import BagError
from hat_ros.io.damage import damage_as_bag_error

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)


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
