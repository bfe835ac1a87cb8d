"""The files that a mesh names: material files and textures. Nothing outside the mesh's own folder is read."""

from __future__ import annotations

import io
import logging
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from PIL import Image
from trimesh.resolvers import Resolver

from hat_ros.errors import MeshError

LOG = logging.getLogger(__name__)

MATERIAL_SUFFIX = ".mtl"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff", ".webp", ".gif")
MAX_COMPANION_BYTES = 256 * 2**20
MAX_TRIED_PX = 64 * 2**20

# Options before the name of a texture in a material file: -s 1 1 1, -clamp on, ...
_MAP_OPTION = re.compile(r"^-[a-z]+(?:\s+(?:on|off|[-+0-9.eE]+))*\s+(?=\S)")


class Companions(Resolver):
    """Reads what a mesh names, and remembers it.

    Args:
        mesh: the mesh's file.
        libraries: material files of an OBJ; ``trimesh`` asks for the first alone and gets the text of all.

    Attributes:
        file_name: name of the mesh's file, as ``trimesh`` asks for it.
        found: path relative to the mesh's folder -> file, of all that was read.
        problems: one sentence for each file that was asked for and is not used.
    """

    def __init__(self, mesh: Path, libraries: Sequence[str] = ()) -> None:
        self.file_name = mesh.name
        self.found: dict[str, Path] = {}
        self.problems: list[str] = []
        self._folder = mesh.parent.resolve()
        self._libraries = libraries

    def get(self, name: str) -> bytes:
        """Content of the file of that name.

        Raises:
            FileNotFoundError: it is missing, or not to be used; the sentence is in ``problems``.
        """
        if self._libraries:
            libraries, self._libraries = self._libraries, ()
            return b"\n".join(self._existing(libraries))
        shown = name.strip()
        path, problem = self._locate(shown)
        data = b""
        if path is not None:
            data = path.read_bytes()
            if path.suffix.lower() != MATERIAL_SUFFIX and not _is_image(data):
                problem = "is not an image that can be decoded"
        if problem or path is None:
            sentence = f"CAD model {self.file_name}: '{shown}', which it names, {problem}: its colours are left out"
            if sentence not in self.problems:
                self.problems.append(sentence)
            raise FileNotFoundError(shown)
        self.found[path.relative_to(self._folder).as_posix()] = path
        return data

    def _existing(self, names: Sequence[str]) -> Iterator[bytes]:
        for name in names:
            with suppress(FileNotFoundError):
                yield self.get(name)

    def _locate(self, name: str) -> tuple[Path | None, str]:
        """The file, or what is wrong."""
        while match := _MAP_OPTION.match(name):
            name = name[match.end() :]
        problem = "is not beside it"
        # As written, as a URI, and as Windows writes it.
        for candidate in dict.fromkeys((name, unquote(name), name.replace("\\", "/"))):
            place = PurePosixPath(candidate)
            if place.is_absolute() or ".." in place.parts or re.match(r"[A-Za-z]:|\\\\", candidate):
                return None, "does not lie in the folder of the model; put it there and name it without a path"
            path = self._folder / place
            if not os.path.isfile(path):  # Path.is_file raises for names that are too long
                continue
            if self._folder not in path.resolve().parents:
                return None, "is a link out of the folder of the model"
            if path.suffix.lower() not in (MATERIAL_SUFFIX, *IMAGE_SUFFIXES):
                return None, f"is neither a material file ({MATERIAL_SUFFIX}) nor an image"
            if path.stat().st_size > MAX_COMPANION_BYTES:
                return None, f"is larger than the accepted {MAX_COMPANION_BYTES} bytes"
            return path, ""
        return None, problem

    def write(self, name: str, data: bytes) -> None:
        """Not for writing."""
        raise PermissionError(name)

    def namespaced(self, namespace: str) -> Companions:
        """The same files: there are no name spaces here."""
        return self

    def keys(self) -> list[str]:
        """What was read so far."""
        return list(self.found)


def copy_with_companions(mesh: Path, found: dict[str, Path], folder: Path, name: str) -> None:
    """Copy a mesh to ``folder/name`` and what it names beside it, under the same relative paths.

    Raises:
        MeshError: one of them would replace a file that is there already.
    """
    for place in found:
        if (folder / place).exists() or place == name:
            raise MeshError(f"CAD model {mesh.name}: '{place}', which it names, is taken in {folder}; rename it")
    shutil.copyfile(mesh, folder / name)
    for place, path in found.items():
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, folder / place)


@cache
def say_once(sentence: str, level: int = logging.WARNING) -> None:
    """Log a sentence once in a process: a model is read several times in a run."""
    LOG.log(level, "%s", sentence)


def _is_image(data: bytes) -> bool:
    """Whether it decodes to its end; one that is too large to try passes, and is refused by its size."""
    try:
        with Image.open(io.BytesIO(data)) as image:
            if image.size[0] * image.size[1] <= MAX_TRIED_PX:
                image.load()
    except Exception:  # whatever the broken bytes lead the decoder to
        return False
    return True
