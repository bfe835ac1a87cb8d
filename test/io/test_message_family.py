"""Both families of message classes carry the same."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from wire_samples import BAG, ROS, STAMP, candidates, pose_rows, through_dds

from hat_ros.errors import FrameError
from hat_ros.io import messages
from hat_ros.io.rosbag import TYPESTORE


@given(stamp=st.integers(0, 2**31 * 10**9 - 1))
@settings(max_examples=50, deadline=None)
def test_stamps_survive_to_the_nanosecond(stamp):
    assert messages.stamp_of(through_dds(ROS.pose(stamp, "cam", pose_rows(1)[0]))) == stamp


def test_stamp_beyond_ros_time_is_refused():
    with pytest.raises(FrameError, match="does not fit"):
        ROS.header(2**31 * 10**9, "cam")


def test_both_families_of_classes_serialize_to_the_same_bytes():
    for name, args in (("candidates", (STAMP, "cam", candidates())), ("pose", (STAMP, "cam", pose_rows(1)[0]))):
        ours = getattr(BAG, name)(*args)
        bag_bytes = bytes(TYPESTORE.serialize_cdr(ours, ours.__msgtype__))
        assert bag_bytes == serialize_message(getattr(ROS, name)(*args))[: len(bag_bytes)]
