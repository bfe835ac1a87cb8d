"""Folders that our commands make and may replace: told by a file of our own in them, never by what they look like.

Whatever lacks that file is never deleted, empty folders apart. While a command writes a folder it holds a lock on the
file, so that no second command begins to write there.
"""

from __future__ import annotations

import fcntl
import shutil
from pathlib import Path
from types import TracebackType

from hat_ros.errors import RunError, UsageError

MARKER = ".hat_ros"
_CONTENT = "hat_ros made this folder and may replace it.\n"


def checked_out(path: str | Path) -> Path:
    """A path that a command may make a folder at.

    Raises:
        UsageError: it is empty, the current folder or one that holds it, the root, a file, or below a file.
    """
    path = Path(path)
    whole = path.resolve()
    if whole == Path.cwd() or whole in Path.cwd().parents:
        raise UsageError(f"--out '{path}' is the current folder or one that holds it: name a new folder")
    for place in (whole, *whole.parents):
        if place.exists() and not place.is_dir():
            raise UsageError(f"--out {path}: {place} is a file, not a folder: choose another --out")
    return path


def mark(folder: Path) -> None:
    """Say in a folder that we have made it."""
    (folder / MARKER).write_text(_CONTENT, encoding="utf-8")


def require_ours(folder: Path) -> None:
    """Check that a folder may be deleted: we have made it, or it is empty.

    Raises:
        UsageError: it is none of ours, or cannot be read.
    """
    try:
        if (folder / MARKER).is_file() and (folder / MARKER).read_text(encoding="utf-8") == _CONTENT:
            return
        ours = folder.is_dir() and not folder.is_symlink() and not any(folder.iterdir())
    except (OSError, UnicodeDecodeError):
        ours = False
    if not ours:
        raise UsageError(
            f"{folder} exists and is not a folder that hat has made (it has no {MARKER} file): it is not replaced, "
            f"choose another --out or remove it"
        )


def remove(folder: Path) -> None:
    """Delete a folder of ours, if it is there.

    Raises:
        UsageError: it is none of ours.
        RunError: it cannot be deleted.
    """
    if not folder.exists() and not folder.is_symlink():
        return
    require_ours(folder)
    try:
        shutil.rmtree(folder)
    except OSError as error:
        raise RunError(f"cannot delete {folder}: {error.strerror}") from None


class NewFolder:
    """A fresh folder of ours, locked until it is closed; a context manager.

    What an earlier command of ours left there is deleted.

    Args:
        path: the folder.

    Raises:
        UsageError: another command is writing there, or the folder is none of ours.
        RunError: it cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.exists():
            require_ours(path)
            if (path / MARKER).is_file():
                with (path / MARKER).open("rb") as marker:
                    _lock(marker.fileno(), path)
                    remove(path)
            else:
                remove(path)
        try:
            path.mkdir(parents=True)
            self._marker = (path / MARKER).open("x", encoding="utf-8")
        except FileExistsError:
            raise _busy(path) from None
        except OSError as error:
            raise RunError(f"cannot create {path}: {error.strerror}") from None
        _lock(self._marker.fileno(), path)
        try:
            self._marker.write(_CONTENT)
            self._marker.flush()
        except OSError as error:
            self._marker.close()
            raise RunError(f"cannot write into {path}: {error.strerror}") from None

    def __enter__(self) -> NewFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._marker.close()


def _lock(descriptor: int, path: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _busy(path) from None


def _busy(path: Path) -> UsageError:
    return UsageError(f"another command is writing {path}: wait for it, or choose another --out")
