"""Files of a bag's folder: the manifest that notices every altered bit, and a file that survives a full disk."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
from pathlib import Path
from typing import BinaryIO

from hat_ros.errors import BagError

MANIFEST = "manifest.json"
RESERVE = ".reserve"

# The last chunk (1 MiB and one message), the index and the metadata of a long run.
_RESERVE_BYTES = 8 * 2**20


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(2**20):
            digest.update(block)
    return digest.hexdigest()


def write_manifest(folder: Path) -> None:
    """Write the SHA-256 of every file in the folder beside them."""
    files = sorted(file for file in folder.iterdir() if file.is_file() and file.name != MANIFEST)
    digests = {file.name: sha256_of(file) for file in files}
    (folder / MANIFEST).write_text(json.dumps({"sha256": digests}, indent=2) + "\n", encoding="utf-8")


def check_manifest(folder: Path) -> None:
    """Compare the files with ``manifest.json``; a bag without one is accepted as it is.

    Raises:
        BagError: a listed file is missing or altered, or the manifest is unreadable.
    """
    path = folder / MANIFEST
    if not folder.is_dir() or not path.is_file():
        return
    try:
        digests = json.loads(path.read_text(encoding="utf-8"))["sha256"]
        items = sorted(digests.items())
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise BagError(f"{path} is not a manifest: delete it to read the bag unchecked") from None
    for name, digest in items:
        file = folder / Path(name).name
        if not file.is_file():
            raise BagError(f"{folder} lacks {name}, which its manifest lists: copy the bag again")
        if sha256_of(file) != digest:
            raise BagError(
                f"{file} is not the file that was recorded (SHA-256 differs from {MANIFEST}): copy the bag again, "
                f"or delete the manifest to read it unchecked"
            )


class ReservedFile:
    """A file with some disk space put by: when the disk fills up, the reserve makes room to finish in good order.

    Args:
        file: the file as the MCAP writer opened it, still empty.
        reserve: file that holds the reserve.
    """

    def __init__(self, file: BinaryIO, reserve: Path) -> None:
        file.flush()
        # Unbuffered, so that after an error it is known which bytes are in the file.
        self.raw: io.RawIOBase = file.detach()
        self._reserve = reserve
        self.is_full = False
        with reserve.open("wb") as out:
            os.posix_fallocate(out.fileno(), 0, _RESERVE_BYTES)

    def write(self, data: bytes | memoryview) -> int:
        """Write all of it, if need be into the reserve; :attr:`is_full` tells."""
        view = memoryview(data).cast("B")
        while view:
            try:
                view = view[self.raw.write(view) :]
            except OSError as error:
                if error.errno not in (errno.ENOSPC, errno.EDQUOT) or self.is_full:
                    raise
                self.is_full = True
                self.free_reserve()
        return memoryview(data).nbytes

    def tell(self) -> int:
        """Position in the file."""
        return self.raw.tell()

    def free_reserve(self) -> None:
        """Give the reserved space back."""
        self._reserve.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file."""
        self.raw.close()
