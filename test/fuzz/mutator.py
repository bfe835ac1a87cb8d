"""Changes valid inputs into ones that nearly are: flips, cuts, blocks copied or deleted, numbers and words swapped."""

from __future__ import annotations

import re
import struct
from random import Random

BINARY_NUMBERS = [
    *(struct.pack("<I", value) for value in (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFE, 0xFFFFFFFF)),
    *(struct.pack("<Q", value) for value in (0, 2**31, 2**53, 2**63 - 1, 2**63, 2**64 - 1)),
    *(struct.pack("<f", value) for value in (float("nan"), float("inf"), -1e38, 1e-45)),
    *(struct.pack("<d", value) for value in (float("nan"), -float("inf"), 1e308, 5e-324)),
]
NUMERALS = "0 -0 1 -1 2 255 256 -2147483648 4294967295 9223372036854775808 1e999 -1e308 1e-320 nan NaN inf -inf"
SIGNS = "null true false ~ .nan .inf 0x10 1_0 9:9 [] {} [[]] '' \" : - # & * !!int .. / \\"
WORDS = (
    *NUMERALS.split(),
    *SIGNS.split(),
    "a\tb",
    "9" * 400,
    "x" * 3000,
    "[" * 60,
    "é\u2028\u0000",
    "٣",
)
_WORD = re.compile(r"[^\s,:\[\]{}\"']+")


def mutated(data: bytes, rng: Random, is_text: bool = False) -> bytes:
    """One to six changes, few more often than many."""
    changes = (_swap_word, _swap_word, *_BINARY) if is_text else _BINARY
    for _ in range(min(6, 1 + int(rng.expovariate(1.5)))):
        data = rng.choice(changes)(data, rng)
    return data


def spliced(data: bytes, other: bytes, rng: Random) -> bytes:
    """The beginning of one and the end of the other."""
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


def _flip(data: bytes, rng: Random) -> bytes:
    if not data:
        return data
    out = bytearray(data)
    # Headers are short; half of the flips hit the first bytes.
    reach = len(out) if rng.random() < 0.5 else min(len(out), 256)
    for _ in range(rng.choice((1, 1, 2, 8))):
        out[rng.randrange(reach)] ^= 1 << rng.randrange(8)
    return bytes(out)


def _truncate(data: bytes, rng: Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _block(data: bytes, rng: Random) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.choice((1, 4, 16, 64, 500)))


def _copy(data: bytes, rng: Random) -> bytes:
    (start, stop), at = _block(data, rng), rng.randrange(len(data) + 1)
    return data[:at] + data[start:stop] + data[at:]


def _delete(data: bytes, rng: Random) -> bytes:
    start, stop = _block(data, rng)
    return data[:start] + data[stop:]


def _number(data: bytes, rng: Random) -> bytes:
    number = rng.choice(BINARY_NUMBERS)
    at = rng.randrange(len(data) + 1) & ~3
    return data[:at] + number + data[at + len(number) :]


def _swap_word(data: bytes, rng: Random) -> bytes:
    text = data.decode("utf-8", "surrogateescape")
    found = list(_WORD.finditer(text))
    if not found:
        return data
    word, other = rng.choice(found), rng.choice(found).group()
    new = other if rng.random() < 0.3 else rng.choice(WORDS)
    return (text[: word.start()] + new + text[word.end() :]).encode("utf-8", "surrogateescape")


_BINARY = (_flip, _flip, _truncate, _copy, _delete, _number)
