"""What must hold of an MCAP file before a parser allocates anything from what it declares.

MCAP layout: https://mcap.dev/spec (magic, records of one opcode byte and a 64-bit length, chunks with their declared
uncompressed size).
"""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import BinaryIO, Protocol

import zstandard

from hat_ros.errors import BagError, MissingDependencyError

MAX_CHUNK_BYTES = 512 * 2**20

_MAGIC = b"\x89MCAP0\r\n"
_CHUNK = 0x06
_FOOTER = 0x02
_DATA_END = 0x0F


class Readable(Protocol):
    """A stream of unpacked bytes."""

    def read(self, size: int, /) -> bytes:
        """At most so many bytes; none at the end."""
        ...


def check_mcap(path: Path) -> None:
    """Walk the records of a file: complete, ended by a footer, chunks within limits, every checksum that it has right.

    Raises:
        BagError: truncated, not MCAP, or a decompression bomb.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(8) != _MAGIC:
            raise BagError(f"{path} is not an MCAP file")
        start = file.tell()
        end = size - len(_MAGIC)
        opcode = 0
        while (at := file.tell()) < end:
            header = file.read(9)
            if len(header) < 9:
                raise BagError(f"{path} is truncated at byte {at} of {size}: {_recovery(path)}")
            opcode, length = struct.unpack("<BQ", header)
            if at + 9 + length > end:
                raise BagError(
                    f"{path} is truncated or damaged, a record at byte {at} reaches beyond its end: {_recovery(path)}"
                )
            if opcode == _CHUNK:
                _check_chunk(file, path, length)
            if opcode in (_DATA_END, _FOOTER):
                _check_section(file, path, opcode, start, at)
                start = at + 9 + length
            file.seek(at + 9 + length)
        if opcode != _FOOTER or file.read() != _MAGIC:
            raise BagError(
                f"{path} is truncated, it has no MCAP footer (was the recording interrupted?): {_recovery(path)}"
            )


def _check_chunk(file: BinaryIO, path: Path, length: int) -> None:
    if length < 40:
        raise BagError(f"{path} is damaged: a chunk of {length} bytes cannot hold its own header")
    _, _, declared, expected_crc, name_length = struct.unpack("<QQQII", file.read(32))
    if declared > MAX_CHUNK_BYTES:
        raise BagError(f"{path}: a chunk declares {declared} bytes, more than {MAX_CHUNK_BYTES} are refused")
    if name_length > 16:
        raise BagError(f"{path} is damaged: a chunk's compression name has {name_length} bytes")
    compression = file.read(name_length).decode("ascii", errors="replace")
    (stored,) = struct.unpack("<Q", file.read(8))
    if stored > length - 40 - name_length:
        raise BagError(f"{path} is damaged: a chunk's data reach beyond its record")
    count, crc = unpacked(stream_of(file.read(stored), compression, path), declared, path)
    if count != declared:
        raise BagError(f"{path}: a chunk does not unpack to the {declared} bytes that it declares")
    if expected_crc and crc != expected_crc:
        raise BagError(_altered(path, "a chunk"))


def _check_section(file: BinaryIO, path: Path, opcode: int, start: int, at: int) -> None:
    """The CRC of the data before a DataEnd record, or of the summary up to the footer's own; 0 = there is none."""
    file.seek(at + 9)
    fields = file.read(4 if opcode == _DATA_END else 20)
    (expected_crc,) = struct.unpack("<I", fields[-4:])
    if len(fields) not in (4, 20) or not expected_crc:
        return
    begin, end = (0, at) if opcode == _DATA_END else (start, at + 9 + 16)
    file.seek(begin)
    crc, left = 0, end - begin
    while left and (block := file.read(min(2**20, left))):
        crc, left = zlib.crc32(block, crc), left - len(block)
    if crc != expected_crc:
        raise BagError(_altered(path, "the data" if opcode == _DATA_END else "the summary"))


def _altered(path: Path, what: str) -> str:
    return f"{path} is damaged: {what} differs from its checksum (CRC); copy the bag again"


def _recovery(path: Path) -> str:
    return f"copy it again, or save what is whole with `mcap recover {path} -o {path.stem}_whole.mcap`"


def unpacked(source: Readable, declared: int, path: Path) -> tuple[int, int]:
    """Number of bytes that a stream unpacks to, counted up to one more than declared, and their CRC-32.

    Raises:
        BagError: it cannot be unpacked.
    """
    count, crc, limit = 0, 0, declared + 1
    try:
        while count < limit and (block := source.read(min(2**20, limit - count))):
            count, crc = count + len(block), zlib.crc32(block, crc)
    except (zstandard.ZstdError, RuntimeError, EOFError, OSError) as error:
        raise BagError(f"{path} is damaged: a chunk cannot be unpacked ({error})") from None
    return count, crc


def stream_of(data: bytes, compression: str, path: Path) -> Readable:
    """The stream that unpacks a chunk.

    Args:
        data: the chunk as stored.
        compression: ``zstd``, ``lz4``, or empty for none.
        path: the file, for errors.

    Raises:
        BagError: another compression.
        MissingDependencyError: LZ4 is not installed.
    """
    if not compression:
        return io.BytesIO(data)
    if compression == "zstd":
        return zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data), read_across_frames=True)
    if compression != "lz4":
        raise BagError(f"{path}: chunk compression '{compression}' is not supported (zstd, lz4 or none)")
    # Bags of our own are written with zstd; LZ4 is asked for only where a bag of others needs it.
    try:
        from lz4.frame import LZ4FrameFile
    except ModuleNotFoundError:
        raise MissingDependencyError(
            f"{path} has chunks compressed by LZ4, and the package 'lz4' is not installed: `pip install lz4`"
        ) from None
    return LZ4FrameFile(io.BytesIO(data))
