"""Recordings of ROS 1: checked, then converted to MCAP once, images, calibration and poses alone.

Format: https://wiki.ros.org/Bags/Format/2.0 (records of a header and data, chunks with their declared size).
"""

from __future__ import annotations

import bz2
import io
import struct
from pathlib import Path
from typing import BinaryIO

from rosbags.convert import convert

from hat_ros.errors import BagError
from hat_ros.io.damage import damage_as_bag_error
from hat_ros.io.integrity import MAX_CHUNK_BYTES, Readable, stream_of, unpacked
from hat_ros.io.rosbag import TYPESTORE

_MAGIC = b"#ROSBAG V2.0\n"
_CHUNK = b"\x05"
_MAX_HEADER_BYTES = 2**20
_KINDS = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
    "geometry_msgs/msg/PoseStamped",
)


def convert_ros1(file: Path, folder: Path) -> Path:
    """Write what a ROS 1 bag holds of a camera as an MCAP file of ROS 2.

    Args:
        file: the ``.bag``.
        folder: where to; it must exist.

    Returns:
        The MCAP file.

    Raises:
        BagError: truncated, damaged, or a decompression bomb.
    """
    check_ros1(file)
    out = folder / file.stem
    with damage_as_bag_error(file):
        convert([file], out, "mcap", 9, None, "none", None, TYPESTORE, [], [], [], _KINDS)
    return out / f"{file.stem}.mcap"


def check_ros1(path: Path) -> None:
    """Walk the records of a file: complete, and no chunk larger than declared or allowed.

    Raises:
        BagError: it is not.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise BagError(f"{path} is no ROS 1 bag of version 2.0")
        while (at := file.tell()) < size:
            fields = _header(file, path, at)
            length = _uint32(file.read(4), path, at)
            begin = file.tell()
            if begin + length > size:
                raise BagError(f"{path} is truncated at byte {at} of {size}: copy it again, or `rosbag reindex` it")
            if fields.get("op") == _CHUNK:
                _check_chunk(path, fields, file.read(length))
            file.seek(begin + length)


def _header(file: BinaryIO, path: Path, at: int) -> dict[str, bytes]:
    length = _uint32(file.read(4), path, at)
    data = file.read(length) if length <= _MAX_HEADER_BYTES else b""
    if len(data) < length:
        raise BagError(f"{path} is truncated or damaged: no record header at byte {at}")
    fields = {}
    while data:
        size = _uint32(data[:4], path, at)
        name, _, value = data[4 : 4 + size].partition(b"=")
        fields[name.decode("ascii", errors="replace")] = value
        data = data[4 + size :]
    return fields


def _uint32(data: bytes, path: Path, at: int) -> int:
    if len(data) < 4:
        raise BagError(f"{path} is truncated or damaged: no record header at byte {at}")
    return int(struct.unpack("<I", data[:4])[0])


def _check_chunk(path: Path, fields: dict[str, bytes], data: bytes) -> None:
    declared = _uint32(fields.get("size", b""), path, 0)
    if declared > MAX_CHUNK_BYTES:
        raise BagError(f"{path}: a chunk declares {declared} bytes, more than {MAX_CHUNK_BYTES} are refused")
    compression = fields.get("compression", b"").decode("ascii", errors="replace")
    source: Readable = (
        bz2.BZ2File(io.BytesIO(data))
        if compression == "bz2"
        else stream_of(data, "" if compression == "none" else compression, path)
    )
    if unpacked(source, declared, path)[0] != declared:
        raise BagError(f"{path}: a chunk does not unpack to the {declared} bytes that it declares")
