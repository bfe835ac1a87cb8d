"""A file that can still be finished in good order when the disk is full."""

from __future__ import annotations

import errno
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

RESERVE = ".reserve"

# The last chunk (1 MiB and one message), the index and the metadata of a long run.
_RESERVE_BYTES = 8 * 2**20


class ReservedFile(io.BufferedIOBase):
    """A new file, and some disk space set aside: when the disk fills up, the reserve makes room for the last bytes.

    It is written through at once, so that after an error it is known which bytes are in the file.

    Args:
        path: file to create; the reserve is ``.reserve`` beside it, until it is closed.

    Attributes:
        is_full: the disk is full and the reserve has been given up: finish now.

    Raises:
        OSError: the file exists or there is no space for the reserve.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._reserve = path.with_name(RESERVE)
        self.is_full = False
        with self._reserve.open("wb") as out:
            os.posix_fallocate(out.fileno(), 0, _RESERVE_BYTES)
        self._raw = path.open("xb", buffering=0)

    def write(self, data: ReadableBuffer) -> int:
        """Write all of it, if need be into the reserve; :attr:`is_full` tells."""
        view = memoryview(data).cast("B")
        while view:
            try:
                view = view[self._raw.write(view) :]
            except OSError as error:
                if error.errno not in (errno.ENOSPC, errno.EDQUOT) or self.is_full:
                    raise
                self.is_full = True
                self._free_reserve()
        return memoryview(data).nbytes

    def writable(self) -> bool:
        """It is."""
        return True

    def tell(self) -> int:
        """Position in the file."""
        return self._raw.tell()

    def close(self) -> None:
        """Close the file and give the reserved space back."""
        if not self.closed:
            self._free_reserve()
            self._raw.close()
        super().close()

    def _free_reserve(self) -> None:
        self._reserve.unlink(missing_ok=True)
