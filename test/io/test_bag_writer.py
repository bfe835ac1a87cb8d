"""What is written comes back, whatever ends the writing."""

from __future__ import annotations

import errno
import json

import cv2
import numpy as np
import pytest
from recording import CAMERA, N, image, mask, pose, stamp, write

from hat_ros.errors import RunError
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.bag_writer import BagWriter
from hat_ros.io.manifest import MANIFEST
from hat_ros.io.reserved_file import RESERVE
from hat_ros.types import Camera


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
    file = writer._folder._file
    file._raw = FullDisk(file._raw, 2_500_000, tmp_path / "bag" / RESERVE)
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
