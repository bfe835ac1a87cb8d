"""Damage in a JPEG that its decoder passes over: it paints what it makes of the broken rest, and returns that.

The coded pixels carry no checksum, but not every string of bits is one that an encoder writes: a code may be none of
its table's, a block may get more than 64 coefficients, a level may be out of range, the data may end before the blocks
or go on after them. OpenCV goes on after each of these, so the codes are followed here first, without making pixels of
them. Bits that make another valid image cannot be noticed by anyone.

Terms, tables and ranges are those of the standard, ITU-T T.81.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import lru_cache
from math import ceil
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from hat_ros.array_types import Int, UInt8
from hat_ros.errors import FrameError

SOI, EOI = b"\xff\xd8", b"\xff\xd9"
_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_SEQUENTIAL = (0xC0, 0xC1)
_DHT, _SOS, _DQT, _DRI = 0xC4, 0xDA, 0xDB, 0xDD
_N_TABLES, _LONGEST_BITS = 4, 16
_SHORT_BITS = 9  # codes up to here are looked up, longer ones, one in a hundred, searched for
_LEVEL = 1024  # the DC coefficient of a block of the darkest or brightest 8-bit values
_DAMAGED = "compressed image is a damaged JPEG"


class _Codes(NamedTuple):
    """Huffman tables: of the DC (0) and the AC coefficients (1), four of each.

    Attributes:
        limit: (2, 4, 17) int64, the next 16 bits hold a code of so many bits or fewer if they are below it.
        first: (2, 4, 17) int64, index of the code in ``symbols``, less the code.
        symbols: (2, 4, 256) int64.
    """

    limit: Int
    first: Int
    symbols: Int


class _Component(NamedTuple):
    """Of the frame: blocks of a unit (H and V), and the table of its quantization."""

    across: int
    down: int
    quantizer: int


def jpeg_size(data: bytes) -> tuple[int, int]:
    """(width, height) px from the header.

    Raises:
        FrameError: there is none.
        IndexError, struct.error: the data end before it.
    """
    for marker, at, _ in _segments(data, len(SOI)):
        if marker in _SOF:
            height, width = struct.unpack_from(">HH", data, at + 1)
            return width, height
    raise FrameError(_DAMAGED)


def check_jpeg(data: bytes) -> None:
    """Refuse coded pixels that no encoder writes.

    Only sequential images (baseline, which cameras and ROS send, and extended) of 8 bits with Huffman codes are
    followed; others pass. Bytes that a camera puts between the end of its coded pixels and the next marker pass, too.

    Raises:
        FrameError: they are damaged.
    """
    try:
        _follow(data)
    except (IndexError, struct.error, ValueError):
        raise FrameError(_DAMAGED) from None


def _segments(data: bytes, at: int) -> Iterator[tuple[int, int, int]]:
    """(marker, begin, end) of the parameters of each marker segment up to a scan or the end of the image."""
    while True:
        at = data.find(0xFF, at)  # some cameras put bytes between segments
        if at < 0:
            raise FrameError(_DAMAGED)
        marker = data[at + 1]
        if marker in (0x00, 0xFF):  # no marker; a fill byte
            at += 1
            continue
        if marker == EOI[1]:
            return
        (length,) = struct.unpack_from(">H", data, at + 2)
        end = at + 2 + length
        if end > len(data):
            raise IndexError("a segment goes beyond the data")
        yield marker, at + 4, end
        if marker == _SOS:
            return
        at = end


def _follow(data: bytes) -> None:
    """Raise FrameError, or what reading beyond the data raises, if the data cannot be an encoder's."""
    pixels = np.frombuffer(data, np.uint8)
    limit, first, symbols = _standard_codes()
    codes = _Codes(limit.copy(), first.copy(), symbols.copy())
    steps = np.zeros(_N_TABLES, np.int64)
    components: dict[int, _Component] = {}
    size, restart, missing, at = (0, 0), 0, set[int](), len(SOI)
    while True:
        scan = None
        for marker, begin, end in _segments(data, at):
            part = data[begin:end]
            if marker in _SOF:
                if marker not in _SEQUENTIAL or part[0] != 8:
                    return
                size, components = _frame_header(part)
                missing = set(components)
            elif marker == _DHT:
                _read_codes(part, codes)
            elif marker == _DQT:
                _read_steps(part, steps)
            elif marker == _DRI:
                (restart,) = struct.unpack(">H", part)
            elif marker == _SOS:
                scan, at = part, end
        if scan is None:
            break
        names = scan[1 : 1 + 2 * scan[0] : 2]
        if len(scan) != 4 + 2 * len(names) or not missing.issuperset(names):
            raise FrameError(_DAMAGED)
        missing -= set(names)
        blocks, n_units = _layout(size, components, names)
        selectors = np.array([(byte >> 4, byte & 15) for byte in scan[2 : 2 + 2 * len(names) : 2]], np.int64)
        if selectors.max() >= _N_TABLES:
            raise FrameError(_DAMAGED)
        scan_steps = np.array([steps[components[name].quantizer] for name in names], np.int64)
        at = _follow_scan(pixels, at, *codes, blocks, selectors, scan_steps, n_units, restart)
        if at < 0:
            raise FrameError(f"{_DAMAGED}: its coded pixels are not what an encoder writes")
        if at == len(data):  # no end marker, but all pixels: some cameras leave it out
            break
    if missing or not components:
        raise FrameError(_DAMAGED)


def _frame_header(part: bytes) -> tuple[tuple[int, int], dict[int, _Component]]:
    """(width, height) px, and the components by their identifiers."""
    height, width, count = struct.unpack_from(">HHB", part, 1)
    found = {
        part[at]: _Component(part[at + 1] >> 4, part[at + 1] & 15, part[at + 2]) for at in range(6, 6 + 3 * count, 3)
    }
    of_range = all(1 <= c.across <= 4 and 1 <= c.down <= 4 and c.quantizer < _N_TABLES for c in found.values())
    if len(part) != 6 + 3 * count or len(found) != count or not found or not of_range:
        raise FrameError(_DAMAGED)
    return (width, height), found


def _layout(size: tuple[int, int], components: dict[int, _Component], names: bytes) -> tuple[Int, int]:
    """Of a scan: the component (an index into ``names``) of each block of a unit (MCU), and the number of units."""
    across = max(c.across for c in components.values())
    down = max(c.down for c in components.values())
    if len(names) == 1:  # a unit is one block
        only = components[names[0]]
        columns, rows = ceil(ceil(size[0] * only.across / across) / 8), ceil(ceil(size[1] * only.down / down) / 8)
        return np.zeros(1, np.int64), columns * rows
    counts = [components[name].across * components[name].down for name in names]
    n_units = ceil(size[0] / (8 * across)) * ceil(size[1] / (8 * down))
    return np.repeat(np.arange(len(names)), counts), n_units


def _read_steps(part: bytes, steps: Int) -> None:
    """The steps of the DC coefficients from the quantization tables of a segment."""
    at = 0
    while at < len(part):
        wide, table = part[at] >> 4, part[at] & 15
        (steps[table],) = struct.unpack_from(">H" if wide else ">B", part, at + 1)
        at += 129 if wide else 65
    if at != len(part):
        raise FrameError(_DAMAGED)


def _read_codes(part: bytes, codes: _Codes) -> None:
    """The Huffman tables of a segment."""
    at = 0
    while at < len(part):
        kind, table, counts = part[at] >> 4, part[at] & 15, part[at + 1 : at + 17]
        total = sum(counts)
        limit, first = _canonical(counts)
        codes.limit[kind, table], codes.first[kind, table] = limit, first
        codes.symbols[kind, table, :total] = np.frombuffer(part, np.uint8, total, at + 17)
        at += 17 + total


@lru_cache(maxsize=64)
def _canonical(counts: bytes) -> tuple[Int, Int]:
    """``limit`` and ``first`` of :class:`_Codes`, each (17,), from the numbers of codes of 1 to 16 bits."""
    limit, first = np.zeros((2, _LONGEST_BITS + 1), np.int64)
    code = index = 0
    for bits, count in enumerate(counts, 1):
        first[bits] = index - code
        code, index = code + count, index + count
        if code > 1 << bits:
            raise FrameError(_DAMAGED)
        limit[bits] = code << (_LONGEST_BITS - bits)
        code <<= 1
    return limit, first


@lru_cache(maxsize=1)
def _standard_codes() -> _Codes:
    """Those of annex K, which OpenCV writes and which cameras that send MJPEG leave out."""
    shape = (2, _N_TABLES, _LONGEST_BITS + 1)
    codes = _Codes(np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.zeros((2, _N_TABLES, 256), np.int64))
    data = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    for marker, begin, end in _segments(data, len(SOI)):
        if marker == _DHT:
            _read_codes(data[begin:end], codes)
    return codes


@njit(cache=True, nogil=True)
def _follow_scan(
    data: UInt8, at: int, limit: Int, first: Int, symbols: Int, blocks: Int, selectors: Int, steps: Int,
    n_units: int, restart: int,
) -> int:  # fmt: skip
    """Index of the marker after a scan whose coded pixels begin at ``at``, or of the end; -1 when they are damaged.

    Args:
        data: (N,) the file.
        at: index of the first byte.
        limit, first, symbols: as in :class:`_Codes`.
        blocks: (B,) component of each block of a unit.
        selectors: (C, 2) DC and AC table of each component.
        steps: (C,) of the DC coefficients.
        n_units: units of the scan.
        restart: units between two restart markers, 0 = there are none.
    """
    dc = np.zeros(len(steps), np.int64)
    short = _short_codes(limit, first, symbols)
    bits, n_bits, n_markers = 0, 0, 0
    for unit in range(n_units):
        if restart and unit and unit % restart == 0:
            at = _padded_end(data, at, bits, n_bits)
            if at < 0 or at + 1 >= len(data) or data[at + 1] != 0xD0 + n_markers % 8:
                return -1
            at, bits, n_bits, n_markers = at + 2, 0, 0, n_markers + 1
            dc[:] = 0
        for component in blocks:
            kind, k = 0, 0
            table = selectors[component, 0]
            row = short[0, table]
            while k < 64:
                if n_bits < _LONGEST_BITS + 11:  # of a code and its value
                    while n_bits <= 48 and at < len(data):
                        byte = int(data[at])
                        if byte == 0xFF:
                            if at + 1 == len(data) or data[at + 1] != 0:
                                break
                            at += 1
                        bits, n_bits, at = ((bits << 8) | byte) & 0xFFFFFFFFFFFFFF, n_bits + 8, at + 1
                code = (bits >> (n_bits - 16) if n_bits >= 16 else bits << (16 - n_bits)) & 0xFFFF
                entry = row[code >> (_LONGEST_BITS - _SHORT_BITS)]
                length, symbol = entry >> 8, entry & 255
                if length == 0:
                    length = _SHORT_BITS + 1
                    while length <= _LONGEST_BITS and code >= limit[kind, table, length]:
                        length += 1
                    if length > _LONGEST_BITS:
                        return -1
                    index = first[kind, table, length] + (code >> (_LONGEST_BITS - length))
                    symbol = symbols[kind, table, index]
                n_value = symbol & 15
                n_bits -= length + n_value
                if n_bits < 0:
                    return -1
                if kind:
                    k += (symbol >> 4) + 1
                    if n_value == 0:
                        if symbol == 0:  # the rest are zeros
                            break
                        if symbol != 0xF0:  # nor sixteen zeros
                            return -1
                    if n_value > 10 or k > 64:
                        return -1
                else:
                    if symbol > 11:
                        return -1
                    if symbol:
                        value = (bits >> n_bits) & ((1 << symbol) - 1)
                        dc[component] += value if value >> (symbol - 1) else value - (1 << symbol) + 1
                    # Rounded to a step, it is beyond the range by half a step at most.
                    if abs(dc[component]) * steps[component] > _LEVEL + steps[component]:
                        return -1
                    kind, k = 1, 1
                    table = selectors[component, 1]
                    row = short[1, table]
    return _padded_end(data, at, bits, n_bits)


@njit(cache=True, nogil=True)
def _short_codes(limit: Int, first: Int, symbols: Int) -> Int:
    """(2, 4, 512) int64: bits of the code that 9 bits begin with * 256 + its symbol; 0 for longer ones."""
    out = np.zeros((2, _N_TABLES, 1 << _SHORT_BITS), np.int64)
    for kind in range(2):
        for table in range(_N_TABLES):
            begin = 0
            for length in range(1, _SHORT_BITS + 1):
                end = limit[kind, table, length] >> (_LONGEST_BITS - _SHORT_BITS)
                for code in range(begin, end):
                    index = first[kind, table, length] + (code >> (_SHORT_BITS - length))
                    out[kind, table, code] = length * 256 + symbols[kind, table, index]
                begin = end
    return out


@njit(cache=True, nogil=True)
def _padded_end(data: UInt8, at: int, bits: int, n_bits: int) -> int:
    """Index of the next marker or of the end; -1 when the codes cannot have ended where the last one did.

    The last byte is filled up with ones, and a camera may then put bytes of its own before the marker; or all is zeros.

    Args:
        data: (N,) the file.
        at: index of the first byte that is not in ``bits``.
        bits: the last ``n_bits`` bits have been read and belong to no code.
        n_bits: see ``bits``.
    """
    n_fill = n_bits & 7
    filled = (bits >> (n_bits - n_fill)) & ((1 << n_fill) - 1) == (1 << n_fill) - 1
    zeros = bits & ((1 << n_bits) - 1) == 0
    while at < len(data):
        if data[at] != 0xFF:
            zeros = zeros and data[at] == 0
            at += 1
        elif at + 1 < len(data) and data[at + 1] == 0:
            zeros = False
            at += 2
        elif at + 1 < len(data) and data[at + 1] == 0xFF:  # a fill byte
            at += 1
        else:
            break
    return at if filled or zeros else -1
