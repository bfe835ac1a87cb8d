"""Frames with their masks, and calibrations."""

from __future__ import annotations

import array

import numpy as np
import pytest
from wire_samples import BAG, ROS, STAMP, through_bag, through_dds

from hat_ros.errors import FrameError, WireError
from hat_ros.io import messages
from hat_ros.types import Camera, Detection


@pytest.mark.parametrize("silhouette", [True, False])
def test_frame_carries_image_and_mask(silhouette):
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
    mask = np.zeros((24, 32), dtype=bool)
    mask[5:9, 3:20] = True
    message = ROS.frame(STAMP, "cam", rgb, Detection(mask, silhouette))
    assert isinstance(message.data, array.array)
    found, detection = messages.frame_from(through_dds(message))
    assert np.array_equal(found, rgb)
    assert np.array_equal(detection.mask, mask)
    assert detection.silhouette is silhouette
    assert messages.frame_from(ROS.frame(STAMP, "cam", rgb, None))[1] is None


def test_frame_with_another_encoding_or_alpha_is_rejected():
    rgba = np.zeros((4, 4, 4), dtype=np.uint8)
    rgba[0, 0, 3] = 7
    with pytest.raises(WireError, match="alpha must be 0 and either 128"):
        messages.frame_from(ROS.image(STAMP, "cam", "rgba8", rgba))
    rgba[0, 0, 3], rgba[1, 1, 3] = 128, 255
    with pytest.raises(WireError, match="alpha"):
        messages.frame_from(ROS.image(STAMP, "cam", "rgba8", rgba))
    with pytest.raises(WireError, match="rgba8"):
        messages.frame_from(ROS.image(STAMP, "cam", "bgra8", rgba))


def test_camera_info_round_trips_and_refuses_what_a_pinhole_is_not():
    camera = Camera(np.array([[500.5, 0.25, 160.1], [0, 501.5, 120.2], [0, 0, 1.0]]), 320, 240)
    for make, carry in ((ROS, through_dds), (BAG, through_bag)):
        found = messages.camera_from(carry(make.camera_info(STAMP, "cam", camera)))
        assert np.array_equal(found.K, camera.K)
        assert (found.width, found.height) == (camera.width, camera.height)
    message = ROS.camera_info(STAMP, "cam", camera)
    message.d = [0.1, 0.0, 0.0, 0.0, 0.0]
    with pytest.raises(FrameError, match=r"camera_info\.d must be zero"):
        messages.camera_from(message)
    message = ROS.camera_info(STAMP, "cam", camera)
    message.binning_x = 2
    with pytest.raises(FrameError, match="binning"):
        messages.camera_from(message)
    message = ROS.camera_info(STAMP, "cam", camera)
    message.k[0] = np.nan
    with pytest.raises(FrameError, match="finite"):
        messages.camera_from(message)
