"""Recordings of ROS 1 are read like others; damaged ones end in one sentence."""

from __future__ import annotations

import bz2
import struct

import numpy as np
import pytest
from recording import CAMERA, N, image, pose, stamp
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from hat_ros.errors import BagError
from hat_ros.geometry import lie
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.ros1 import check_ros1

STORE = get_typestore(Stores.ROS1_NOETIC)


def make(kind, **fields):
    return STORE.types[kind](**fields)


def header(index):
    seconds, rest = divmod(stamp(index), 1_000_000_000)
    time = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
    return make("std_msgs/msg/Header", seq=index, stamp=time, frame_id="cam")


def camera_info(index):
    roi = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0) | {"do_rectify": False}
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=header(index),
        height=30,
        width=40,
        distortion_model="plumb_bob",
        D=np.zeros(5),
        K=CAMERA.K.ravel(),
        R=np.eye(3).ravel(),
        P=np.column_stack([CAMERA.K, np.zeros(3)]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=make("sensor_msgs/msg/RegionOfInterest", **roi),
    )


def picture(index):
    data = image(index).ravel()
    fields = {"height": 30, "width": 40, "encoding": "rgb8", "is_bigendian": 0, "step": 120, "data": data}
    return make("sensor_msgs/msg/Image", header=header(index), **fields)


def truth(index):
    x, y, z, *quat = lie.row_from_matrix(pose(index))
    kind = "geometry_msgs/msg/"
    where = make(f"{kind}Point", x=x, y=y, z=z)
    turn = make(f"{kind}Quaternion", **dict(zip("xyzw", quat, strict=True)))
    return make(f"{kind}PoseStamped", header=header(index), pose=make(f"{kind}Pose", position=where, orientation=turn))


@pytest.fixture(params=[None, Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4])
def old_bag(tmp_path, request):
    path = tmp_path / "old.bag"
    writer = Writer(path)
    if request.param is not None:
        writer.set_compression(request.param)
    with writer:
        for topic, build in (
            ("/cam/camera_info", camera_info),
            ("/cam/image_raw", picture),
            ("/ground_truth/target_pose", truth),
        ):
            kind = build(0).__msgtype__
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for index in range(N):
                writer.write(connection, stamp(index), STORE.serialize_ros1(build(index), kind))
    return path


@pytest.mark.parametrize("as_folder", [False, True])
def test_a_ros_1_bag_gives_frames_calibration_and_truth(old_bag, as_folder):
    reader = BagReader(old_bag.parent if as_folder else old_bag)
    frames = list(reader.frames())
    assert [frame.stamp_ns for frame in frames] == [stamp(index) for index in range(N)]
    assert all(np.array_equal(frame.rgb, image(index)) for index, frame in enumerate(frames))
    assert np.array_equal(reader.camera.K, CAMERA.K)
    assert np.allclose(reader.truth()[stamp(2)], pose(2))


def test_every_truncation_ends_in_a_bag_error(old_bag):
    data = old_bag.read_bytes()
    for size in (0, 5, 13, 20, len(data) // 3, len(data) - 200, len(data) - 1):
        old_bag.write_bytes(data[:size])
        with pytest.raises(BagError):
            list(BagReader(old_bag).frames())


def chunk(declared, data, compression=b"bz2"):
    fields = (b"op=\x05", b"compression=" + compression, b"size=" + struct.pack("<I", declared))
    head = b"".join(struct.pack("<I", len(field)) + field for field in fields)
    return b"#ROSBAG V2.0\n" + struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def test_bombs_are_refused_before_they_unpack(tmp_path):
    path = tmp_path / "bomb.bag"
    bomb = bz2.compress(bytes(8 * 2**20))
    path.write_bytes(chunk(2**32 - 1, bomb))
    with pytest.raises(BagError, match="are refused"):
        check_ros1(path)
    path.write_bytes(chunk(1000, bomb))
    with pytest.raises(BagError, match="does not unpack to the 1000 bytes"):
        check_ros1(path)
    path.write_bytes(chunk(1000, b"no bz2"))
    with pytest.raises(BagError, match="cannot be unpacked"):
        check_ros1(path)
