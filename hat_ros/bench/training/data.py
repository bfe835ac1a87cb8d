"""Rendered data of a training on disk: made craft by craft, so that a run that was stopped goes on where it was."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.bench.training.backgrounds import HEIGHT, WIDTH, render_background
from hat_ros.bench.training.recipe import Collection
from hat_ros.bench.training.views import Views, join, render_views

Progress = Callable[[str, int, int], None]
"""Called with what is counted, how many are done, and how many there are."""

_BACKGROUNDS = "backgrounds.npy"
# Backgrounds per file while they are made: seconds of work.
_BLOCK = 50


@dataclass(frozen=True, eq=False)
class Data:
    """What samples are composed from, mapped from disk.

    Attributes:
        views: of all craft of the collection.
        backgrounds: (B, HEIGHT, WIDTH, 3) uint8.
    """

    views: Views
    backgrounds: UInt8


def prepare(collection: Collection, folder: Path, name: str, progress: Progress) -> Data:
    """Render what a folder does not hold yet.

    Args:
        collection: what to render.
        folder: made if need be; what it holds must be of the same collection.
        name: of the collection, for ``progress``.
        progress: see :data:`Progress`.

    Raises:
        MeshError: a CAD file cannot be used.
    """
    _make_views(collection, folder / "views", f"views, {name}", progress)
    _make_backgrounds(collection, folder, f"backgrounds, {name}", progress)
    return Data(Views.load(folder / "views"), np.load(folder / _BACKGROUNDS, mmap_mode="r"))


def _make_views(collection: Collection, folder: Path, title: str, progress: Progress) -> None:
    total = len(collection.sources)
    if not folder.exists():
        parts = [folder.with_name(f"views-{number:06d}") for number in range(total)]
        for number, (source, part) in enumerate(zip(collection.sources, parts, strict=True)):
            if not part.exists():
                partial = _fresh(part)
                render_views(source.load(), number, source.views, collection.seed).save(partial)
                partial.rename(part)
            progress(title, number + 1, total)
        partial = _fresh(folder)
        join(parts, partial)
        partial.rename(folder)
        for part in parts:
            shutil.rmtree(part)
    progress(title, total, total)


def _make_backgrounds(collection: Collection, folder: Path, title: str, progress: Progress) -> None:
    total, path = collection.backgrounds, folder / _BACKGROUNDS
    if not path.exists():
        blocks = [folder / f"backgrounds-{first:06d}.npy" for first in range(0, total, _BLOCK)]
        for number, block in enumerate(blocks):
            first, end = number * _BLOCK, min((number + 1) * _BLOCK, total)
            if not block.exists():
                images = np.stack([render_background(image, collection.seed) for image in range(first, end)])
                np.save(block.with_suffix(".partial.npy"), images)
                block.with_suffix(".partial.npy").rename(block)
            progress(title, end, total)
        joined = np.lib.format.open_memmap(path.with_suffix(".partial.npy"), "w+", np.uint8, (total, HEIGHT, WIDTH, 3))
        for number, block in enumerate(blocks):
            joined[number * _BLOCK : (number + 1) * _BLOCK] = np.load(block)
        joined.flush()
        path.with_suffix(".partial.npy").rename(path)
        for block in blocks:
            block.unlink()
    progress(title, total, total)


def _fresh(folder: Path) -> Path:
    """An empty folder to make the contents of a folder in, until it is renamed."""
    partial = folder.with_name(f"{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    return partial
