"""The files beside a bag's messages: the manifest, which notices every altered bit, and the name of the target's."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

from hat_ros.errors import BagError

MANIFEST = "manifest.json"
TARGET_FILE = "target.yaml"


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(2**20):
            digest.update(block)
    return digest.hexdigest()


def write_manifest(folder: Path) -> None:
    """Write the SHA-256 of every file in the folder, textures in folders of their own included, beside them."""
    files = sorted(file for file in folder.rglob("*") if file.is_file() and file != folder / MANIFEST)
    digests = {file.relative_to(folder).as_posix(): sha256_of(file) for file in files}
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
        file = folder / name
        if folder.resolve() not in file.resolve().parents:
            raise BagError(f"{path} lists {name}, which does not lie in the bag: delete it to read the bag unchecked")
        if not os.path.isfile(file):  # Path.is_file raises for names that are too long
            raise BagError(f"{folder} lacks {name}, which its manifest lists: copy the bag again")
        if sha256_of(file) != digest:
            raise BagError(
                f"{file} is not the file that was recorded (SHA-256 differs from {MANIFEST}): copy the bag again, "
                f"or delete the manifest to read it unchecked"
            )
