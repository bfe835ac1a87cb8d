"""Detections computed elsewhere and shipped beside a recording, for importers to turn into ``Frame.given_mask``.

Three layouts are understood, distinguished by their content, never by file names:

* a JSON list in the style of the BOP challenge and CNOS: ``{"image_id": int or file name, "score": float, ...}`` with
  ``segmentation`` (COCO run lengths, ``{"size": [H, W], "counts": [...] or compressed string}``) and/or ``bbox``
  ``[x, y, w, h]`` in pixels; the best score per image counts. ``scene_id`` and ``category_id`` tell scenes and objects
  of one file apart;
* a JSON mapping from file name (or number) to a box ``[x0, y0, x1, y1]`` in pixels, outer pixel edges;
* a folder of mask images, one per frame under the frame's file name: white = silhouette (a uniform grey 128 = box).

Run lengths follow the COCO mask API (column by column, starting with background).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.errors import DatasetError
from hat_ros.types import MASK_BOX, MASK_SILHOUETTE, MAX_IMAGE_SIDE_PX

MAX_FILE_BYTES = 1 << 30
# Of scores and of pixels; JSON holds integers that no float can.
_LARGEST = 1e9
MASK_SUFFIXES = (".png", ".bmp", ".tif", ".tiff", ".jpg", ".jpeg")

Mask = UInt8


class DetectionLookup:
    """Given masks by frame name.

    A name is matched by its stem; a purely numeric stem also matches as a number, so ``000007.png``, ``7`` and the
    integer 7 are the same frame.
    """

    def __init__(self, entries: Mapping[str, Callable[[tuple[int, int]], Mask]], source: Path) -> None:
        self._entries = dict(entries)
        self._source = source

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, name: str | int) -> bool:
        return _key(name) in self._entries

    def given_mask(self, name: str | int, size: tuple[int, int]) -> Mask | None:
        """The (H, W) uint8 mask of a frame as in ``Frame.given_mask``; None when the frame has no detection.

        Args:
            name: file name, stem or number of the frame.
            size: (height, width) of the frame in pixels.

        Raises:
            DatasetError: the detection's size is not the frame's, or its content is malformed.
        """
        entry = self._entries.get(_key(name))
        if entry is None:
            return None
        mask = entry(size)
        if mask.shape != tuple(size):
            raise DatasetError(
                f"{self._source}: the detection of frame '{name}' is {mask.shape[1]}x{mask.shape[0]} but the image "
                f"is {size[1]}x{size[0]}; give detections made on these images"
            )
        return mask


def load_detections(path: str | Path, scene: tuple[int, int] | None = None) -> DetectionLookup:
    """Read a file or folder of detections; masks are decoded only when asked for.

    Args:
        path: the file or folder.
        scene: (scene, object) of a BOP data set: detections that name another ``scene_id`` or ``category_id`` are left
            out. None takes all, which must then be of one scene.

    Raises:
        DatasetError: nothing there, not one of the three layouts, malformed, or of several scenes.
    """
    path = Path(path)
    if path.is_dir():
        return _from_folder(path)
    if not path.is_file():
        raise DatasetError(f"{path}: no such file or folder of detections")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise DatasetError(f"{path}: larger than {MAX_FILE_BYTES >> 20} MiB, which no detection file should be")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: not valid JSON ({' '.join(str(error).split())})") from None
    if isinstance(data, list):
        return _from_bop_list(data, path, scene)
    if isinstance(data, dict):
        return _from_box_mapping(data, path)
    raise DatasetError(f"{path}: expected a list of detections or a mapping of boxes, found {type(data).__name__}")


def _key(name: str | int) -> str:
    stem = Path(str(name)).stem
    return str(int(stem)) if stem.isascii() and stem.isdigit() else stem


def _from_folder(folder: Path) -> DetectionLookup:
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in MASK_SUFFIXES)
    if not files:
        raise DatasetError(f"{folder}: no mask images ({', '.join(MASK_SUFFIXES)}) in this folder")
    entries: dict[str, Callable[[tuple[int, int]], Mask]] = {}
    for file in files:
        if _key(file.name) in entries:
            raise DatasetError(f"{folder}: two masks for frame '{file.stem}', keep one")
        entries[_key(file.name)] = partial(_read_mask, file)
    return DetectionLookup(entries, folder)


def _read_mask(file: Path, size: tuple[int, int]) -> Mask:
    del size  # a file has its own; the caller compares
    image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise DatasetError(f"{file}: not a readable image")
    if not (image > MASK_BOX).any() and (image == MASK_BOX).any():
        return np.where(image == MASK_BOX, MASK_BOX, 0).astype(np.uint8)
    # Masks are often stored as 0/1 instead of 0/255.
    threshold = 127 if image.max(initial=0) > 1 else 0
    return np.where(image > threshold, MASK_SILHOUETTE, 0).astype(np.uint8)


def _from_bop_list(data: list[Any], path: Path, scene: tuple[int, int] | None) -> DetectionLookup:
    best: dict[str, tuple[float, dict[str, Any]]] = {}
    scenes = set()
    for index, item in enumerate(data):
        key, score = _checked(item, f"{path}: detection {index}")
        if scene is not None and (item.get("scene_id", scene[0]), item.get("category_id", scene[1])) != scene:
            continue
        scenes.add(str(item.get("scene_id", "")))
        if key not in best or score > best[key][0]:
            best[key] = (score, item)
    if len(scenes) > 1:
        names = ", ".join(sorted(scenes)[:3])
        raise DatasetError(
            f"{path}: these are detections of {len(scenes)} scenes ({names} ...); give one scene's alone"
        )
    entries: dict[str, Callable[[tuple[int, int]], Mask]] = {}
    for key, (_, item) in best.items():
        where = f"{path}: image {item['image_id']}"
        if item.get("segmentation") is not None:
            entries[key] = partial(_rle_mask, item["segmentation"], where)
        else:
            x, y, w, h = _four_numbers(item["bbox"], where)
            entries[key] = partial(_box_mask, (x, y, x + w, y + h), where)
    return DetectionLookup(entries, path)


def _checked(item: Any, where: str) -> tuple[str, float]:
    """Frame key and score of one entry of a list."""
    if not isinstance(item, dict) or "image_id" not in item:
        raise DatasetError(f"{where}: expected a mapping with 'image_id' and 'segmentation' or 'bbox'")
    image_id, score = item["image_id"], item.get("score", 1.0)
    if isinstance(image_id, bool) or not isinstance(image_id, (int, str)):
        raise DatasetError(f"{where}: image_id must be a number or a file name, found {image_id!r}")
    if isinstance(score, bool) or not isinstance(score, (int, float)) or not abs(score) <= _LARGEST:
        raise DatasetError(f"{where}: score must be a finite number, found {score!r}")
    if item.get("segmentation") is None and item.get("bbox") is None:
        raise DatasetError(f"{where}: it has neither 'segmentation' nor 'bbox'")
    return _key(image_id), float(score)


def _from_box_mapping(data: dict[str, Any], path: Path) -> DetectionLookup:
    entries: dict[str, Callable[[tuple[int, int]], Mask]] = {}
    for name, box in data.items():
        where = f"{path}: frame '{name}'"
        numbers = _four_numbers(box, where)
        if _key(name) in entries:
            raise DatasetError(f"{where}: a second box for the same frame, keep one")
        entries[_key(name)] = partial(_box_mask, numbers, where)
    return DetectionLookup(entries, path)


def _four_numbers(value: Any, where: str) -> tuple[float, float, float, float]:
    ok = isinstance(value, list) and len(value) == 4
    if not ok or not all(isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) <= _LARGEST for v in value):
        raise DatasetError(f"{where}: a box must be four finite numbers of at most {_LARGEST:g} px, found {value!r}")
    a, b, c, d = value
    return float(a), float(b), float(c), float(d)


def _rle_mask(segmentation: Any, where: str, size: tuple[int, int]) -> Mask:
    del size  # run lengths have their own; the caller compares
    return decode_rle(segmentation, where)


def _box_mask(box: tuple[float, float, float, float], where: str, size: tuple[int, int]) -> Mask:
    x0, y0, x1, y1 = (math.floor(v + 0.5) for v in box)
    if x1 <= x0 or y1 <= y0:
        raise DatasetError(f"{where}: the box {list(box)} is empty; expected x0 < x1 and y0 < y1")
    mask = np.zeros(size, np.uint8)
    mask[max(0, y0) : max(0, y1), max(0, x0) : max(0, x1)] = MASK_BOX
    return mask


def decode_rle(segmentation: Any, where: str = "segmentation") -> Mask:
    """COCO run lengths -> (H, W) uint8 mask of 0 and 255.

    Args:
        segmentation: ``{"size": [H, W], "counts": list of ints or compressed ASCII string}``.
        where: named in error messages.

    Raises:
        DatasetError: malformed, of absurd size, or runs that do not add up to H x W.
    """
    if not isinstance(segmentation, dict) or not {"size", "counts"} <= set(segmentation):
        raise DatasetError(f"{where}: expected run lengths {{'size': [H, W], 'counts': ...}}")
    size, counts = segmentation["size"], segmentation["counts"]
    ok = isinstance(size, list) and len(size) == 2 and all(type(v) is int for v in size)
    if not ok or not all(0 < v <= MAX_IMAGE_SIDE_PX for v in size):
        raise DatasetError(f"{where}: run-length size must be [H, W] of 1 to {MAX_IMAGE_SIDE_PX} px, found {size!r}")
    if isinstance(counts, str):
        counts = _decompress_counts(counts, where)
    if not isinstance(counts, list) or not all(type(v) is int and v >= 0 for v in counts):
        raise DatasetError(f"{where}: run lengths must be non-negative integers")
    if sum(counts) != size[0] * size[1]:
        raise DatasetError(f"{where}: run lengths add up to {sum(counts)} px, the size needs {size[0] * size[1]}")
    values = np.zeros(len(counts), np.uint8)
    values[1::2] = MASK_SILHOUETTE
    return np.ascontiguousarray(np.repeat(values, counts).reshape(size[1], size[0]).T)


def _decompress_counts(text: str, where: str) -> list[int]:
    """COCO's string form: base-32 digits from '0' up, bit 5 = more follows, differences to the run before last."""
    counts: list[int] = []
    value, shift = 0, 0
    for char in text:
        digit = ord(char) - 48
        if not 0 <= digit < 64 or shift > 30:
            raise DatasetError(f"{where}: the compressed run lengths hold the invalid character {char!r}")
        value |= (digit & 31) << shift
        shift += 5
        if digit & 32:
            continue
        if digit & 16:
            value -= 1 << shift
        counts.append(value + counts[-2] if len(counts) > 2 else value)
        value, shift = 0, 0
    if shift:
        raise DatasetError(f"{where}: the compressed run lengths end in the middle of a number")
    return counts
