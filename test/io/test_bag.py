"""Recordings round-trip, and whatever a damaged one holds ends in one clear sentence."""

from __future__ import annotations

import errno
import json
import shutil
import struct

import numpy as np
import pytest
import zstandard
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from hat_ros.errors import BagError, FrameError, HatError, RunError
from hat_ros.geometry import lie
from hat_ros.io import topics
from hat_ros.io.bag import TYPESTORE, BagReader, BagWriter
from hat_ros.io.bag_files import MANIFEST, RESERVE
from hat_ros.io.integrity import check_mcap
from hat_ros.io.messages import Wire
from hat_ros.types import Camera

CAMERA = Camera(np.array([[60.0, 0, 19.5], [0, 60.0, 14.5], [0, 0, 1]]), 40, 30)
N = 6
WIRE = Wire.bag(TYPESTORE)


def stamp(index):
    return 1_000_000_123 + index * 100_000_000


def image(index):
    return np.random.default_rng(index).integers(0, 256, (30, 40, 3), dtype=np.uint8)


def mask(index):
    out = np.zeros((30, 40), np.uint8)
    out[5 : 10 + index, 5:20] = 255
    return out


def pose(index):
    return lie.transform(lie.so3_exp(np.array([0.1 * index, 0.2, 0.3])), np.array([0.0, 0.1, 5.0 + index]))


def write(path, n=N, **options):
    with BagWriter(path, **options) as writer:
        for index in range(n):
            given = mask(index) if index % 2 else None
            writer.write_frame(stamp(index), image(index), CAMERA, mask=given, T_cam_target=pose(index))
    return path


@pytest.fixture
def bag(tmp_path):
    return write(tmp_path / "bag")


@pytest.mark.parametrize("image_format", ["raw", "png"])
def test_frames_come_back_bit_for_bit(tmp_path, image_format):
    reader = BagReader(write(tmp_path / "bag", image_format=image_format))
    frames = list(reader.frames())
    assert len(reader) == len(frames) == N
    for index, frame in enumerate(frames):
        assert frame.stamp_ns == stamp(index)
        assert np.array_equal(frame.rgb, image(index))
        assert np.array_equal(frame.camera.K, CAMERA.K)
        assert (frame.given_mask is not None) == bool(index % 2)
        if index % 2:
            assert np.array_equal(frame.given_mask, mask(index))
    truth = reader.truth()
    assert list(truth) == [stamp(index) for index in range(N)]
    assert np.allclose(truth[stamp(2)], pose(2), atol=1e-12)
    assert (reader.frame_id, reader.has_masks, reader.compressed) == ("camera", True, image_format == "png")


def test_jpeg_bytes_of_an_importer_are_kept(tmp_path):
    import cv2

    data = cv2.imencode(".jpg", image(0))[1].tobytes()
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_frame(stamp(0), data, CAMERA)
    reader = BagReader(tmp_path / "bag")
    (packet,) = reader.packets()
    assert data in packet.image
    assert next(reader.frames()).rgb.shape == (30, 40, 3)
    assert reader.truth() == {}


def test_target_travels_in_the_bag(tmp_path):
    mesh = tmp_path / "cad.stl"
    mesh.write_bytes(b"solid")
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_frame(stamp(0), image(0), CAMERA)
        writer.write_target(mesh, 0.001, "thing")
    path = BagReader(tmp_path / "bag").target_path
    assert path.read_text() == "mesh: cad.stl\nunit_scale: 0.001\nname: thing\n"
    listed = json.loads((tmp_path / "bag" / MANIFEST).read_text())["sha256"]
    assert set(listed) == {"bag.mcap", "cad.stl", "metadata.yaml", "target.yaml"}
    assert BagReader(write(tmp_path / "other")).target_path is None


def test_a_single_mcap_file_is_a_bag_too(bag):
    assert len(list(BagReader(bag / "bag.mcap").frames())) == N


def test_existing_folder_is_not_overwritten(bag):
    with pytest.raises(RunError, match="exists already"):
        BagWriter(bag)


def test_a_stopped_writer_leaves_a_readable_bag(tmp_path):
    with pytest.raises(KeyboardInterrupt), BagWriter(tmp_path / "bag") as writer:
        writer.write_frame(stamp(0), image(0), CAMERA)
        raise KeyboardInterrupt
    assert len(list(BagReader(tmp_path / "bag").frames())) == 1


class FullDisk:
    """Takes so many bytes, and more only once the reserve has been given up."""

    def __init__(self, raw, room, reserve):
        self.raw, self.room, self.reserve = raw, room, reserve

    def write(self, data):
        if self.reserve is not None and not self.reserve.exists():
            self.room, self.reserve = self.room + 2**23, None
        count = min(len(data), self.room)
        if not count:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.room -= count
        return self.raw.write(data[:count])

    def __getattr__(self, name):
        return getattr(self.raw, name)


def test_a_full_disk_leaves_what_was_written_readable(tmp_path):
    writer = BagWriter(tmp_path / "bag")
    assert (tmp_path / "bag" / RESERVE).stat().st_blocks > 0
    writer._file.raw = FullDisk(writer._file.raw, 2_500_000, tmp_path / "bag" / RESERVE)
    written = 0
    with pytest.raises(RunError, match="disk is full"):
        while True:
            pixels = np.random.default_rng(written).integers(0, 256, (480, 640, 3), dtype=np.uint8)
            writer.write_frame(stamp(written), pixels, Camera(CAMERA.K, 640, 480))
            written += 1
    writer.close()
    assert not (tmp_path / "bag" / RESERVE).exists()
    frames = list(BagReader(tmp_path / "bag").frames())
    assert written >= 2
    assert len(frames) in (written, written + 1), "the frame that filled the disk is in the bag too"


def test_a_closed_writer_says_so(tmp_path):
    writer = BagWriter(tmp_path / "bag")
    writer.close()
    writer.close()
    with pytest.raises(RunError, match="closed already"):
        writer.write_frame(stamp(0), image(0), CAMERA)


# ------------------------------------------------------------------ bags of others


def foreign(path, image_topic="/cam0/image_raw", plugin=StoragePlugin.SQLITE3, extra=(), camera=CAMERA, n=3):
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        info = writer.add_connection("/cam0/camera_info", "sensor_msgs/msg/CameraInfo", typestore=TYPESTORE)
        images = writer.add_connection(image_topic, "sensor_msgs/msg/Image", typestore=TYPESTORE)
        for topic in extra:
            writer.add_connection(topic, "sensor_msgs/msg/Image", typestore=TYPESTORE)
        for index in range(n):
            for connection, message in (
                (info, WIRE.camera_info(stamp(index), "cam0", camera)),
                (images, WIRE.image(stamp(index), "cam0", "bgr8", image(index)[..., ::-1])),
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


def test_several_image_topics_must_be_chosen_from(tmp_path):
    path = foreign(tmp_path / "bag", extra=("/cam1/image_raw",))
    with pytest.raises(BagError, match=r"several image topics, choose one: /cam0/image_raw, /cam1/image_raw"):
        BagReader(path)
    assert len(BagReader(path, image_topic="/cam0/image_raw")) == 3
    with pytest.raises(BagError, match="no image topic '/nope', it has: /cam0"):
        BagReader(path, image_topic="/nope")


# ------------------------------------------------------------------ bad bags


def test_missing_things_are_named(tmp_path, bag):
    with pytest.raises(BagError, match="does not exist"):
        BagReader(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BagError, match=r"no metadata\.yaml"):
        BagReader(tmp_path / "empty")
    with BagWriter(tmp_path / "no_images") as writer:
        writer.write_message(topics.CAMERA_INFO, WIRE.camera_info(1, "c", CAMERA), 1)
    with pytest.raises(BagError, match="no image topic"):
        BagReader(tmp_path / "no_images")
    with BagWriter(tmp_path / "no_info") as writer:
        writer.write_message(topics.IMAGE, WIRE.image(1, "c", "rgb8", image(0)), 1)
    with pytest.raises(BagError, match="no camera_info topic"):
        BagReader(tmp_path / "no_info")


def test_altered_files_are_noticed_by_the_manifest(bag):
    file = bag / "bag.mcap"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    with pytest.raises(BagError, match="SHA-256 differs"):
        BagReader(bag)
    file.unlink()
    with pytest.raises(BagError, match=r"lacks bag\.mcap"):
        BagReader(bag)
    (bag / MANIFEST).write_text("[1]")
    with pytest.raises(BagError, match="not a manifest"):
        BagReader(bag)


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


def chunk_of(data, declared, compression=b"zstd"):
    body = struct.pack("<QQQI", 0, 1, declared, 0) + struct.pack("<I", len(compression)) + compression
    body += struct.pack("<Q", len(data)) + data
    footer = struct.pack("<BQQQI", 2, 20, 0, 0, 0)
    return b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(body)) + body + footer + b"\x89MCAP0\r\n"


def test_compression_bombs_are_refused_before_they_unpack(tmp_path):
    path = tmp_path / "bomb.mcap"
    bomb = zstandard.ZstdCompressor().compress(bytes(64 * 2**20))
    assert len(bomb) < 10_000
    path.write_bytes(chunk_of(bomb, 2**62))
    with pytest.raises(BagError, match="are refused"):
        check_mcap(path)
    path.write_bytes(chunk_of(bomb, 1000))
    with pytest.raises(BagError, match="does not unpack to the 1000 bytes"):
        check_mcap(path)
    path.write_bytes(chunk_of(bomb * 50, 64 * 2**20))  # one frame as declared, then forty-nine more
    with pytest.raises(BagError, match="does not unpack"):
        check_mcap(path)
    path.write_bytes(chunk_of(b"garbage", 100))
    with pytest.raises(BagError, match="cannot be unpacked"):
        check_mcap(path)
    path.write_bytes(chunk_of(b"x", 1, b"brotli"))
    with pytest.raises(BagError, match="'brotli' is not supported"):
        check_mcap(path)


def test_unusable_calibration_is_named(tmp_path):
    for index, (change, complaint) in enumerate(
        [
            (lambda m: m.k.__setitem__(0, np.nan), "finite"),
            (lambda m: m.k.__setitem__(0, -1.0), "fx, fy > 0"),
            (lambda m: setattr(m, "width", 0), "image size"),
            (lambda m: m.d.__setitem__(0, 0.5), "rectify first"),
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
    with pytest.raises(FrameError, match=f"frame {stamp(1)}: image must be uint8"):
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


def test_mcap_written_here_is_read_by_others(bag):
    from mcap.reader import make_reader

    with (bag / "bag.mcap").open("rb") as file:
        messages = sum(1 for _ in make_reader(file).iter_messages())
    with Reader(bag) as reader:
        assert messages == reader.message_count == 3 * N + N // 2


def test_compressed_storage_modes_are_refused_with_advice(bag, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(bag, copy)
    (copy / MANIFEST).unlink()
    metadata = (copy / "metadata.yaml").read_text()
    metadata = metadata.replace("compression_mode: ''", "compression_mode: message")
    metadata = metadata.replace("compression_format: ''", "compression_format: zstd")
    (copy / "metadata.yaml").write_text(metadata)
    with pytest.raises(BagError, match="ros2 bag convert"):
        BagReader(copy)
