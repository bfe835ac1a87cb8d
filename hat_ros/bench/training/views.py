"""Views of spacecraft without background: what training images are composed from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.bench.synth.sunlit import Light, SunlitRenderer
from hat_ros.bench.training.coding import encode
from hat_ros.geometry import lie
from hat_ros.target.model import Target
from hat_ros.types import Camera

# Longer side of a view, pixels: a little more than the network sees of a tracked target (160).
_SIDE_PX = 176
# Range in bounding radii of the craft: from a wide lens nearby to a long one.
_RANGE_RADII = (2.5, 15.0)
# Light from all sides, share of that of a sunlit white face: in space between these two, evenly in its logarithm ...
_AMBIENT_SPACE = (0.001, 0.03)
# ... and up to this in a room or close to a bright planet, which is so in this share of the views.
_AMBIENT_ROOM = 0.5
_SHARE_ROOM = 0.2
# Share of views in which the sun stands on the camera's side of the craft: most missions plan for that.
_SHARE_FRONT = 0.75
# Share of views that the Earth lights as well, and its light at most, in the same unit.
_SHARE_EARTHSHINE, _MAX_EARTHSHINE = 0.3, 0.1
# A craft that is seen in fewer rows or columns than this is left out.
_MIN_SIDE_PX = 4

_PIXELS, _INDEX = "pixels.npy", "index.npy"


@dataclass(frozen=True, eq=False)
class Views:
    """N views in one block of memory, which may lie on disk.

    Attributes:
        pixels: (P, 4) uint8, radiance premultiplied by coverage (``coding``) and coverage, view after view.
        index: (N, 4) int64: first pixel, height and width in pixels, number of the craft.
    """

    pixels: UInt8
    index: np.ndarray

    def __len__(self) -> int:
        return len(self.index)

    def view(self, number: int) -> UInt8:
        """(h, w, 4) of one view."""
        start, height, width, _ = self.index[number]
        return self.pixels[start : start + height * width].reshape(height, width, 4)

    def another(self, number: int, rng: np.random.Generator) -> int:
        """Number of a view of the same craft, drawn at random."""
        same = np.flatnonzero(self.index[:, 3] == self.index[number, 3])
        return int(same[rng.integers(len(same))])

    def save(self, folder: Path) -> None:
        """Write to a folder that exists."""
        np.save(folder / _PIXELS, self.pixels)
        np.save(folder / _INDEX, self.index)

    @classmethod
    def load(cls, folder: Path) -> Views:
        """Map what :meth:`save` or :func:`join` wrote."""
        return cls(np.load(folder / _PIXELS, mmap_mode="r"), np.load(folder / _INDEX))


def render_views(craft: Target, number: int, count: int, seed: int) -> Views:
    """Views of one craft from anywhere in light from anywhere.

    Args:
        craft: the target.
        number: of the craft; the views hang on it and the seed alone, whatever other craft there are.
        count: views to draw; those in which next to nothing of the craft is seen are left out.
        seed: of directions, ranges and light.
    """
    rng = np.random.default_rng([seed, number])
    renderer = SunlitRenderer(craft, supersample=2)
    views = [view for _ in range(count) if (view := _render(renderer, craft, rng)) is not None]
    starts = np.cumsum([0, *(view.shape[0] * view.shape[1] for view in views)])
    index = [(start, *view.shape[:2], number) for start, view in zip(starts, views, strict=False)]
    pixels = [view.reshape(-1, 4) for view in views]
    return Views(np.concatenate([np.empty((0, 4), np.uint8), *pixels]), np.array(index, np.int64).reshape(-1, 4))


def join(parts: Sequence[Path], folder: Path) -> None:
    """Write the views of several folders, in their order, as one, without holding them all in memory."""
    index = [Views.load(part).index for part in parts]
    starts = np.cumsum([0, *(int((rows[:, 1] * rows[:, 2]).sum()) for rows in index)])
    pixels = np.lib.format.open_memmap(folder / _PIXELS, "w+", np.uint8, (int(starts[-1]), 4))
    for part, rows, start, end in zip(parts, index, starts[:-1], starts[1:], strict=True):
        pixels[start:end] = Views.load(part).pixels
        rows[:, 0] += start
    pixels.flush()
    np.save(folder / _INDEX, np.concatenate(index))


def _render(renderer: SunlitRenderer, craft: Target, rng: np.random.Generator) -> UInt8 | None:
    """(h, w, 4) of a random view, cut to the target; None when next to nothing is seen."""
    ratio = np.exp(rng.uniform(*np.log(_RANGE_RADII)))
    focal = 0.5 * (_SIDE_PX - 2) * np.sqrt(ratio**2 - 1.0)
    middle = (_SIDE_PX - 1) / 2
    camera = Camera(np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]]), _SIDE_PX, _SIDE_PX)
    R = lie.matrix_from_quat(rng.normal(size=4))
    T = lie.transform(R, np.array([0, 0, ratio * craft.bounding_radius_m]) - R @ craft.center_m)
    to_sun = rng.normal(size=3)
    to_sun[2] = -abs(to_sun[2]) if rng.random() < _SHARE_FRONT else abs(to_sun[2])
    in_room = rng.random() < _SHARE_ROOM
    ambient = _AMBIENT_ROOM * rng.random() if in_room else np.exp(rng.uniform(*np.log(_AMBIENT_SPACE)))
    to_earth = rng.normal(size=3) if rng.random() < _SHARE_EARTHSHINE else None
    light = Light(to_sun, ambient, to_earth, _MAX_EARTHSHINE * rng.random())
    radiance, coverage = renderer.render(T, camera, light)
    rows, columns = np.flatnonzero(coverage.any(axis=1)), np.flatnonzero(coverage.any(axis=0))
    if len(rows) < _MIN_SIDE_PX or len(columns) < _MIN_SIDE_PX:
        return None
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    alpha = (255 * coverage[box] + 0.5).astype(np.uint8)
    return np.dstack([encode(radiance[box]), alpha])
