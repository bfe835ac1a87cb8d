"""The rules by which frames enter the graph and messages meet again, without any middleware.

Streams are FIFO each; between streams any delay is possible. Nothing here looks at a clock or at arrival order, so the
graph computes what one process would.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hat_ros.errors import FrameError, RunError

# A clock that stepped back sends frames that are old and in order among themselves. A duplicate or a late frame stands
# alone, and of a driver that sends a few frames again not so many come in a row.
RESTART_FRAMES = 5
# Old items of one stream that are kept until it is known whether the stamps begin anew: as many as a queue holds.
_EARLY_ITEMS = 16
_NEVER_NS = -(2**63)


class ExactJoin:
    """Joins one item of each named stream by exact stamp, and hands the joined sets out in stamp order.

    Args:
        names: the streams.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._pending: dict[int, dict[str, Any]] = {}
        self._old: dict[str, dict[int, Any]] = {name: {} for name in names}
        self._passed_ns = _NEVER_NS
        self.late = 0

    def __len__(self) -> int:
        """Stamps of which something is waiting."""
        return len(self._pending)

    def put(self, name: str, stamp_ns: int, item: Any) -> None:
        """Add an item; one for a stamp that has been passed already is no part of a set and counted in :attr:`late`.

        It is kept, though, until the next set is taken: it may have come before the word that stamps begin anew.
        """
        if stamp_ns > self._passed_ns:
            self._pending.setdefault(stamp_ns, {})[name] = item
            return
        self.late += 1
        old = self._old[name]
        old.pop(stamp_ns, None)
        old[stamp_ns] = item
        if len(old) > _EARLY_ITEMS:
            del old[next(iter(old))]

    def restart(self, decider: str, stamp_ns: int) -> None:
        """Stamps begin anew at this one, as the stream ``decider`` says: its sets so far are given up.

        Items of the other streams that came before that word are kept, as far as the stamps may be new ones.
        """
        begun = {stamp: items for stamp, items in self._pending.items() if decider not in items and stamp >= stamp_ns}
        for name, old in self._old.items():
            for stamp in [stamp for stamp in old if stamp >= stamp_ns]:
                begun.setdefault(stamp, {})[name] = old[stamp]
                self.late -= 1
            old.clear()
        self._pending, self._passed_ns = begun, stamp_ns - 1

    def peek(self) -> tuple[int, dict[str, Any]] | None:
        """Stamp and items of the earliest complete set, None when there is none; it stays."""
        complete = [stamp for stamp, items in self._pending.items() if len(items) == len(self._names)]
        return (min(complete), self._pending[min(complete)]) if complete else None

    def take(self) -> tuple[int, dict[str, Any]]:
        """Remove the earliest complete set.

        Raises:
            LookupError: there is none; ask :meth:`peek` first.
            RunError: something of an earlier stamp is still missing. Streams are FIFO, so it never comes: it was lost.
        """
        head = self.peek()
        if head is None:
            raise LookupError("no complete set to take")
        stamp_ns, items = head
        missing = self.missing()
        if missing is not None and missing[0] < stamp_ns:
            raise RunError(f"a message was lost: frame {missing[0]} never had {', '.join(missing[1])}")
        del self._pending[stamp_ns]
        self._passed_ns = stamp_ns
        for old in self._old.values():
            old.clear()
        return stamp_ns, items

    def drop_before(self, stamp_ns: int) -> None:
        """Give up what waits for stamps before this one."""
        for stamp in [stamp for stamp in self._pending if stamp < stamp_ns]:
            del self._pending[stamp]
        self._passed_ns = max(self._passed_ns, stamp_ns - 1)

    def missing(self) -> tuple[int, tuple[str, ...]] | None:
        """The earliest incomplete stamp and the streams it still lacks."""
        waiting = [stamp for stamp, items in self._pending.items() if len(items) < len(self._names)]
        if not waiting:
            return None
        stamp_ns = min(waiting)
        return stamp_ns, tuple(name for name in self._names if name not in self._pending[stamp_ns])


class Admission:
    """The only entrance: numbers frames, holds W credits, and knows what is in flight.

    Args:
        credits: W, frames that may be in flight; each status returns one.
        restarts: stamps may begin anew: after :data:`RESTART_FRAMES` - 1 frames in a row that were refused as old, and
            were in order among themselves, the next one of them enters. Otherwise old frames are refused for ever.
    """

    def __init__(self, credits: int, restarts: bool = False) -> None:
        self._credits, self._restarts = credits, restarts
        self._in_flight: dict[int, None] = {}
        self._n_old, self._newest_old_ns = 0, 0
        self.last_stamp_ns = 0
        self.seq = -1

    @property
    def in_flight(self) -> tuple[int, ...]:
        """Stamps admitted and not answered, oldest first."""
        return tuple(self._in_flight)

    @property
    def has_credit(self) -> bool:
        """Whether another frame may enter now."""
        return len(self._in_flight) < self._credits

    def begins_anew(self, stamp_ns: int) -> bool:
        """Whether this stamp may enter although it is not later than the last one: the clock has stepped back."""
        in_order = self._n_old >= RESTART_FRAMES - 1 and stamp_ns > self._newest_old_ns
        return self._restarts and in_order and stamp_ns <= self.last_stamp_ns

    def check(self, stamp_ns: int) -> None:
        """Refuse a stamp that may not enter; the caller drops its frame.

        Raises:
            FrameError: the stamp is zero, negative, or not later than that of the last admitted frame.
        """
        if stamp_ns <= 0:
            raise FrameError(f"header.stamp must be positive, found {stamp_ns} ns: stamp images with the exposure time")
        if stamp_ns > self.last_stamp_ns or self.begins_anew(stamp_ns):
            return
        self._n_old = self._n_old + 1 if stamp_ns > self._newest_old_ns else 1
        self._newest_old_ns = stamp_ns
        raise FrameError(
            f"header.stamp must increase, found {stamp_ns} ns after {self.last_stamp_ns} ns: "
            f"the frame is a duplicate or out of order"
        )

    def admit(self, stamp_ns: int) -> int:
        """Let a frame in and number it from 0; it takes one credit.

        Raises:
            FrameError: see :meth:`check`.
        """
        self.check(stamp_ns)
        self.last_stamp_ns = stamp_ns
        self._n_old, self._newest_old_ns = 0, 0
        self.seq += 1
        self._in_flight[stamp_ns] = None
        return self.seq

    def answered(self, stamp_ns: int) -> bool:
        """Return the credit of a frame; False when it was not in flight (given up, or never ours)."""
        if stamp_ns not in self._in_flight:
            return False
        del self._in_flight[stamp_ns]
        return True

    def forget_stamps(self) -> None:
        """Let any stamp in next, one that is older than the last one, too; only where stamps may begin anew."""
        if self._restarts:
            self.last_stamp_ns = 0

    def give_up(self) -> tuple[int, ...]:
        """Forget all frames in flight and return their stamps: a stage did not answer."""
        lost = self.in_flight
        self._in_flight.clear()
        return lost
