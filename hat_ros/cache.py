"""Arrays that are expensive to make and depend on nothing but their key, kept in the user's cache folder.

An entry is a folder of ``.npy`` files, written beside its final place and renamed, so that a reader never meets half
of one. Reading verifies a digest of every array; an entry that does not agree is rebuilt. Arrays come back
memory-mapped and read-only, so five processes share one copy.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray]

# Some fifty CAD models with all their views.
MAX_BYTES = 4 * 2**30
_MANIFEST = "manifest.json"


def cache_folder() -> Path:
    """``$XDG_CACHE_HOME/hat_ros``, by default ``~/.cache/hat_ros``."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path("~/.cache").expanduser()) / "hat_ros"


def cached_arrays(kind: str, key: str, build: Callable[[], Mapping[str, NDArray]]) -> Arrays:
    """The arrays stored under ``key``, or those of ``build()``, which are then stored.

    A cache that cannot be written is no error: the arrays are then built again next time.

    Args:
        kind: what it is, first part of the folder's name.
        key: everything that the content depends on, format version included.
        build: makes named arrays; called when the entry is absent or damaged.
    """
    entry = _entry(kind, key)
    stored = _read(entry)
    if stored is not None:
        return stored
    arrays = {name: np.ascontiguousarray(array) for name, array in build().items()}
    _write(entry, arrays)
    stored = _read(entry)  # before another process may find the cache too large
    _trim(entry.parent, keep=entry)
    return stored or arrays


def discard(kind: str, key: str) -> None:
    """Delete an entry that is no longer needed, if it is there; who has it mapped keeps the arrays."""
    shutil.rmtree(_entry(kind, key), ignore_errors=True)


def _entry(kind: str, key: str) -> Path:
    return cache_folder() / f"{kind}-{hashlib.sha256(key.encode()).hexdigest()[:32]}"


def _digest(array: NDArray) -> str:
    return hashlib.blake2b(array.data.cast("B") if array.size else b"", digest_size=16).hexdigest()


def _read(entry: Path) -> Arrays | None:
    try:
        digests = json.loads((entry / _MANIFEST).read_text(encoding="utf-8"))
        arrays = {name: np.load(entry / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in digests}
        if all(_digest(arrays[name]) == digests[name] for name in digests):
            with contextlib.suppress(OSError):  # read-only
                os.utime(entry)  # says when it was used last
            return arrays
    except Exception:  # absent, truncated, or not what we wrote: a damaged header makes its parsers raise anything
        return None
    return None


def _write(entry: Path, arrays: Arrays) -> None:
    with contextlib.suppress(OSError):  # read-only or full: go on without
        entry.parent.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(prefix=f".{entry.name}-", dir=entry.parent))
        try:
            for name, array in arrays.items():
                np.save(fresh / f"{name}.npy", array, allow_pickle=False)
            manifest = {name: _digest(array) for name, array in arrays.items()}
            (fresh / _MANIFEST).write_text(json.dumps(manifest), encoding="utf-8")
            shutil.rmtree(entry, ignore_errors=True)
            fresh.rename(entry)  # another process may have been faster: its entry holds the same bytes
        finally:
            shutil.rmtree(fresh, ignore_errors=True)


def _trim(folder: Path, keep: Path) -> None:
    """Delete the entries that were not used for longest, until the rest fits; who has one mapped keeps its arrays."""
    entries = []
    for entry in folder.glob("*-*"):
        with contextlib.suppress(OSError):  # deleted by another process
            size = sum(file.stat().st_size for file in entry.iterdir())
            entries.append((entry.stat().st_mtime_ns, entry, size))
    excess = sum(size for _, _, size in entries) - MAX_BYTES
    for _, entry, size in sorted(entries):
        if excess <= 0:
            break
        if entry != keep:
            shutil.rmtree(entry, ignore_errors=True)
            excess -= size
