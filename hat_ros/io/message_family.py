"""Two families of message classes behind one interface: rclpy's, for the graph, and those of ``rosbags``, for bags."""

from __future__ import annotations

import array
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from typing import Any, Self

import numpy as np

from hat_ros.errors import FrameError, WireError

_NS_PER_S = 1_000_000_000
_MAX_SEC = 2**31


def stamp_of(message: Any) -> int:
    """Stamp of a message's header in nanoseconds.

    Raises:
        WireError: the nanoseconds field is out of range.
    """
    stamp = message.header.stamp
    if not 0 <= stamp.nanosec < _NS_PER_S:
        raise WireError(f"header.stamp.nanosec must be below 1e9, found {stamp.nanosec}")
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


class MessageFamily:
    """Makes messages of one family.

    Args:
        message_class: full type name (``sensor_msgs/msg/Image``) -> message class, taking keyword arguments.
        octets: bytes-like -> what the family takes in a ``uint8[]`` field.
        numbers: floats -> what the family takes in a ``float64[]`` field.
    """

    def __init__(
        self,
        message_class: Callable[[str], type],
        octets: Callable[[Any], Any],
        numbers: Callable[[Sequence[float]], Any],
    ) -> None:
        self._class = message_class
        self._octets = octets
        self._numbers = numbers

    @classmethod
    def ros(cls) -> Self:
        """For rclpy; ``uint8[]`` fields are ``array.array`` because rclpy copies that one whole."""

        def octets(data: Any) -> array.array:
            out = array.array("B")
            out.frombytes(data)
            return out

        return cls(message_class, octets, lambda values: array.array("d", values))

    @classmethod
    def bag(cls, typestore: Any) -> Self:
        """For ``rosbags``' messages of a typestore."""
        return cls(
            typestore.types.__getitem__,
            lambda data: np.frombuffer(data, dtype=np.uint8),
            lambda values: np.array(values, dtype=np.float64),
        )

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """std_msgs/Header."""
        sec, nanosec = divmod(int(stamp_ns), _NS_PER_S)
        if not -_MAX_SEC <= sec < _MAX_SEC:
            raise FrameError(f"stamp {stamp_ns} ns does not fit a ROS time stamp (32 bit seconds)")
        stamp = self._class("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)
        return self._class("std_msgs/msg/Header")(stamp=stamp, frame_id=frame_id)


@cache
def message_class(name: str) -> type:
    """rclpy's class of a full type name, ``package/msg/Name``."""
    package, kind, short = name.split("/")
    return getattr(import_module(f"{package}.{kind}"), short)
