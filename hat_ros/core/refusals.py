"""What was not let in: frames that were refused, counted by reason, so that none vanishes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

_LABEL = re.compile(r"^frame -?\d+( refused)?: ")
_NUMBER = re.compile(r"-?\d+(\.\d+)?(e[+-]?\d+)?")
_MOST_REASONS = 20
_OTHER = "other reasons"


class Refusals:
    """Refused frames. Sentences that differ in their numbers alone are one reason, told by the first of them.

    Beyond twenty reasons the rest are counted together: what a damaged recording says has no bound.
    """

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._first: dict[str, str] = {}

    def add(self, sentence: str, count: int = 1) -> None:
        """Count a frame that was refused for this reason."""
        reason = _NUMBER.sub("#", _LABEL.sub("", sentence))
        if reason not in self._counts and len(self._counts) >= _MOST_REASONS:
            reason, sentence = _OTHER, _OTHER
        self._counts[reason] = self._counts.get(reason, 0) + count
        self._first.setdefault(reason, sentence)

    @property
    def total(self) -> int:
        """Frames refused."""
        return sum(self._counts.values())

    def records(self) -> list[dict[str, Any]]:
        """``count`` and ``first`` sentence of every reason, in the order in which they came up; plain values."""
        return [{"count": count, "first": self._first[reason]} for reason, count in self._counts.items()]

    @classmethod
    def from_records(cls, records: Iterable[Mapping[str, Any]]) -> Refusals:
        """The inverse of :meth:`records`."""
        out = cls()
        for record in records:
            out.add(str(record["first"]), int(record["count"]))
        return out

    def __str__(self) -> str:
        """One sentence: the first case of every reason, with its count."""
        return "; ".join(f"{record['count']} x {record['first']}" for record in self.records())
