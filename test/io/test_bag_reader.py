"""Bags of any origin are read, and whatever a damaged one holds ends in one clear sentence."""

from __future__ import annotations

import numpy as np
import pytest
from recording import CAMERA, WIRE, N, image, mask, stamp
from rosbags.rosbag2 import StoragePlugin, Writer

from hat_ros.config import CameraConfig
from hat_ros.errors import BagError, FrameError, HatError
from hat_ros.io import topics
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.bag_writer import BagWriter
from hat_ros.io.manifest import MANIFEST
from hat_ros.io.rosbag import TYPESTORE
from hat_ros.types import Camera


def foreign(path, image_topic="/cam0/image_raw", plugin=StoragePlugin.SQLITE3, extra=(), camera=CAMERA, n=3):
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        info = writer.add_connection("/cam0/camera_info", "sensor_msgs/msg/CameraInfo", typestore=TYPESTORE)
        images = writer.add_connection(image_topic, "sensor_msgs/msg/Image", typestore=TYPESTORE)
        others = [writer.add_connection(topic, "sensor_msgs/msg/Image", typestore=TYPESTORE) for topic in extra]
        for index in range(n):
            for connection, message in (
                (info, WIRE.camera_info(stamp(index), "cam0", camera)),
                *((to, WIRE.image(stamp(index), "cam0", "bgr8", image(index)[..., ::-1])) for to in (images, *others)),
            ):
                data = TYPESTORE.serialize_cdr(message, connection.msgtype)
                writer.write(connection, stamp(index) + 5_000_000, data)
    return path


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_other_names_storage_and_no_manifest(tmp_path, plugin):
    reader = BagReader(foreign(tmp_path / "bag", plugin=plugin))
    frames = list(reader.frames())
    assert [frame.stamp_ns for frame in frames] == [stamp(index) for index in range(3)]
    assert np.array_equal(frames[1].rgb, image(1))
    assert (reader.image_topic, reader.frame_id, reader.has_masks) == ("/cam0/image_raw", "cam0", False)


def test_a_single_mcap_file_is_a_bag_too(bag):
    assert len(list(BagReader(bag / "bag.mcap").frames())) == N


def test_several_image_topics_must_be_chosen_from(tmp_path):
    path = foreign(tmp_path / "bag", extra=("/cam1/image_raw",))
    with pytest.raises(BagError, match="several image topics, choose one by --image-topic: /cam0/image_raw, /cam1/"):
        BagReader(path)
    assert len(BagReader(path, image_topic="/cam0/image_raw")) == 3
    with pytest.raises(BagError, match="no image topic '/nope', it has: /cam0"):
        BagReader(path, image_topic="/nope")


def test_missing_things_are_named(tmp_path, bag):
    with pytest.raises(BagError, match="does not exist"):
        BagReader(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BagError, match=r"neither metadata\.yaml nor a file"):
        BagReader(tmp_path / "empty")
    with BagWriter(tmp_path / "no_images") as writer:
        writer.write_message(topics.CAMERA_INFO, WIRE.camera_info(1, "c", CAMERA), 1)
    with pytest.raises(BagError, match="no image topic"):
        BagReader(tmp_path / "no_images")
    with BagWriter(tmp_path / "no_info") as writer:
        writer.write_message(topics.IMAGE, WIRE.image(1, "c", "rgb8", image(0)), 1)
    with pytest.raises(BagError, match="no camera_info topic"):
        BagReader(tmp_path / "no_info")


def read_all(path):
    reader = BagReader(path)
    return list(reader.frames()), reader.truth()


def test_every_truncation_ends_in_a_bag_error(bag):
    (bag / MANIFEST).unlink()
    file = bag / "bag.mcap"
    data = file.read_bytes()
    for size in [0, 1, 7, 8, 9, 40, len(data) // 3, len(data) // 2, len(data) - 40, len(data) - 1]:
        file.write_bytes(data[:size])
        with pytest.raises(BagError):
            read_all(bag)


def test_random_bytes_are_no_bag(bag):
    (bag / MANIFEST).unlink()
    rng = np.random.default_rng(0)
    for size in (0, 10, 5000):
        (bag / "bag.mcap").write_bytes(rng.bytes(size))
        with pytest.raises(BagError, match="not an MCAP file"):
            read_all(bag)
    (bag / "metadata.yaml").write_bytes(rng.bytes(300))
    with pytest.raises(BagError):
        read_all(bag)


def test_flipped_bits_without_a_manifest_end_in_frames_or_one_sentence(bag):
    (bag / MANIFEST).unlink()
    file = bag / "bag.mcap"
    data = file.read_bytes()
    rng = np.random.default_rng(1)
    for _ in range(40):
        bad = bytearray(data)
        for at in rng.integers(0, len(bad), rng.integers(1, 4)):
            bad[at] ^= 1 << rng.integers(8)
        file.write_bytes(bad)
        try:
            read_all(bag)
        except HatError as error:
            assert "\n" not in str(error)


def test_unusable_calibration_is_named(tmp_path):
    for index, (change, complaint) in enumerate(
        [
            (lambda m: m.k.__setitem__(0, np.nan), "finite"),
            (lambda m: m.k.__setitem__(0, -1.0), "fx, fy > 0"),
            (lambda m: setattr(m, "width", 0), "image size"),
            (lambda m: m.d.__setitem__(0, np.inf), "camera_info.d must be finite"),
        ]
    ):
        message = WIRE.camera_info(stamp(0), "c", CAMERA)
        change(message)
        path = tmp_path / f"bag{index}"
        with BagWriter(path) as writer:
            writer.write_message(topics.CAMERA_INFO, message, 1)
            writer.write_message(topics.IMAGE, WIRE.image(stamp(0), "c", "rgb8", image(0)), 1)
        with pytest.raises(FrameError, match=complaint):
            list(BagReader(path).frames())


def test_changing_calibration_asks_for_a_split(tmp_path):
    other = Camera(CAMERA.K * np.array([[2, 1, 1], [1, 2, 1], [1, 1, 1]]), 40, 30)
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_frame(stamp(0), image(0), CAMERA)
        writer.write_frame(stamp(1), image(1), other)
    with pytest.raises(BagError, match=f"calibration changes at stamp {stamp(1)}"):
        list(BagReader(tmp_path / "bag").frames())


def test_malformed_frames_are_named_by_their_stamp(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_frame(stamp(0), image(0), CAMERA)
        writer.write_message(topics.IMAGE, WIRE.image(stamp(1), "c", "rgb8", image(1)[:20]), stamp(1))
    frames = BagReader(tmp_path / "bag").frames()
    next(frames)
    with pytest.raises(FrameError, match=f"frame {stamp(1)}: image is 40x20 px but camera_info is for 40x30 px"):
        next(frames)


def test_truth_that_is_no_pose_is_refused(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_frame(stamp(0), image(0), CAMERA)
        bad = WIRE.pose(stamp(0), "c", np.array([0.0, 0, 1, 0, 0, 0, 0]))
        writer.write_message(topics.GROUND_TRUTH, bad, stamp(0))
    with pytest.raises(BagError, match="is no pose"):
        BagReader(tmp_path / "bag").truth()


def test_topics_of_another_type_are_refused(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_frame(stamp(0), image(0), CAMERA)
        writer.write_message(topics.GROUND_TRUTH, WIRE.image(1, "c", "rgb8", image(0)), 1)
    with pytest.raises(BagError, match="must be geometry_msgs/msg/PoseStamped"):
        BagReader(tmp_path / "bag")


def test_masks_out_of_order_still_find_their_images(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for index in (1, 0, 2):
            writer.write_message(
                topics.DETECTION_MASK, WIRE.image(stamp(index), "c", "mono8", mask(index)), stamp(index)
            )
        for index in range(4):
            writer.write_frame(stamp(index), image(index), CAMERA)
    found = [frame.given_mask is not None for frame in BagReader(tmp_path / "bag").frames()]
    assert found == [True, True, True, False]


def calibrated(path, calibrations):
    """A bag with these camera_info messages and one image."""
    with BagWriter(path) as writer:
        for index, message in enumerate(calibrations):
            writer.write_message(topics.CAMERA_INFO, message, stamp(index))
        writer.write_message(topics.IMAGE, WIRE.image(stamp(0), "c", "rgb8", image(0)), stamp(0))
    return path


def camera_info(share=1.0, p_share=1.0):
    message = WIRE.camera_info(stamp(0), "c", CAMERA)
    message.k[:6] *= share
    message.p[:8] *= share * p_share
    return message


def test_empty_calibrations_are_skipped_and_jitter_is_none(tmp_path):
    path = calibrated(tmp_path / "bag", [camera_info(0.0), *(camera_info(1 + 1e-7 * i) for i in range(4))])
    assert np.array_equal(BagReader(path).camera.K, CAMERA.K)


def test_only_empty_calibrations_are_one_sentence(tmp_path):
    reader = BagReader(calibrated(tmp_path / "bag", [camera_info(0.0)] * 3))
    with pytest.raises(BagError, match="/camera_info says that the camera is not calibrated, K has no focal length"):
        _ = reader.camera


def test_slow_drift_is_a_new_calibration_too(tmp_path):
    reader = BagReader(calibrated(tmp_path / "bag", [camera_info(1 + 4e-7 * i) for i in range(9)]))
    with pytest.raises(BagError, match=f"the calibration changes at stamp {stamp(0)}"):
        _ = reader.camera


@pytest.mark.parametrize(("option", "share"), [("true", 0.9), ("false", 1.0), ("auto", None)])
def test_option_rectified_chooses_the_matrix(tmp_path, option, share):
    path = calibrated(tmp_path / "bag", [camera_info(p_share=0.9)])
    reader = BagReader(path, camera_config=CameraConfig(rectified=option))
    if share is None:
        with pytest.raises(FrameError, match=r"set camera\.rectified \(--rectified\) to true or false"):
            _ = reader.camera
    else:
        assert reader.camera.K[0, 0] == pytest.approx(share * CAMERA.K[0, 0])


def test_of_several_calibrations_that_beside_the_image_counts(tmp_path):
    other = Camera(CAMERA.K * 2 - np.diag([0, 0, 1]), CAMERA.width, CAMERA.height)
    with BagWriter(tmp_path / "bag") as writer:
        for topic, camera in (("/camera_info", other), ("/cam1/camera_info", CAMERA), ("/cam2/camera_info", other)):
            writer.write_message(topic, WIRE.camera_info(stamp(0), "c", camera), stamp(0))
        writer.write_message("/cam1/image_raw", WIRE.image(stamp(0), "c", "rgb8", image(0)), stamp(0))
    reader = BagReader(tmp_path / "bag")
    assert reader.camera_info_topic == "/cam1/camera_info"
    assert np.array_equal(reader.camera.K, CAMERA.K)
