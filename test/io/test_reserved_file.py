"""The reserve: there while the file is open, given up when the disk is full, and everything written through at once."""

from __future__ import annotations

import errno

import pytest

from hat_ros.io.reserved_file import RESERVE, ReservedFile


class TightDisk:
    """Takes ``room`` bytes, and ``more`` once the reserve is gone."""

    def __init__(self, raw, reserve, room, more):
        self.raw, self.reserve, self.room, self.more = raw, reserve, room, more

    def write(self, data):
        room = self.room + (0 if self.reserve.exists() else self.more) - self.raw.tell()
        if room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.raw.write(data[:room])

    def __getattr__(self, name):
        return getattr(self.raw, name)


@pytest.fixture
def tight(tmp_path):
    file = ReservedFile(tmp_path / "file")
    file._raw = TightDisk(file._raw, tmp_path / RESERVE, room=10, more=20)
    yield file
    file.close()


def test_bytes_are_in_the_file_at_once(tmp_path):
    file = ReservedFile(tmp_path / "file")
    assert file.write(b"abc") == 3
    assert (tmp_path / "file").read_bytes() == b"abc"
    assert (file.tell(), file.is_full) == (3, False)
    file.close()
    assert not (tmp_path / RESERVE).exists()
    with pytest.raises(FileExistsError):
        ReservedFile(tmp_path / "file")


def test_the_reserve_takes_what_the_disk_does_not(tight, tmp_path):
    assert tight.write(bytes(8)) == 8
    assert not tight.is_full
    assert tight.write(bytes(15)) == 15
    assert tight.is_full
    assert (tmp_path / "file").stat().st_size == 23


def test_a_reserve_that_is_too_small_is_an_error(tight):
    with pytest.raises(OSError, match="No space left"):
        tight.write(bytes(31))
