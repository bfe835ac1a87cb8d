"""A file is checked before a parser trusts what it declares."""

from __future__ import annotations

import struct
import sys

import lz4.frame
import pytest
import zstandard

from hat_ros.errors import BagError, MissingDependencyError
from hat_ros.io.integrity import check_mcap


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


def test_lz4_chunks_of_other_recorders_are_unpacked(tmp_path):
    path = tmp_path / "other.mcap"
    path.write_bytes(chunk_of(lz4.frame.compress(bytes(1000)), 1000, b"lz4"))
    check_mcap(path)
    path.write_bytes(chunk_of(lz4.frame.compress(bytes(1001)), 1000, b"lz4"))
    with pytest.raises(BagError, match="does not unpack to the 1000 bytes"):
        check_mcap(path)


def test_without_the_lz4_package_only_lz4_chunks_are_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lz4.frame", None)
    path = tmp_path / "other.mcap"
    path.write_bytes(chunk_of(zstandard.ZstdCompressor().compress(bytes(1000)), 1000))
    check_mcap(path)
    path.write_bytes(chunk_of(b"any", 1000, b"lz4"))
    with pytest.raises(MissingDependencyError, match="pip install lz4"):
        check_mcap(path)
