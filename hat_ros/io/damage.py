"""One error for all that damaged bytes cause."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hat_ros.errors import BagError, HatError


@contextmanager
def damage_as_bag_error(where: Path) -> Iterator[None]:
    """Whatever a parser of foreign bytes raises means one thing: the bag is damaged."""
    try:
        yield
    except HatError:
        raise
    except Exception as error:  # struct, YAML, sqlite, zstd, lz4 and assertion errors alike
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise BagError(f"{where} is damaged or no bag: {reason}; record or copy it again") from None
