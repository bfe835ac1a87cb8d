"""The frames of a recording as a run would take them in: stamps, refusals, grey levels, size of the target."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from hat_ros.array_types import UInt8
from hat_ros.bench.source import Source
from hat_ros.core.refusals import Refusals
from hat_ros.core.sync import Admission
from hat_ros.errors import FrameError
from hat_ros.io.bag_reader import BagReader
from hat_ros.segmentation.stage import SegmentationStage
from hat_ros.types import Frame

# Frames in which the target is sought where no masks are given.
_SEGMENTED = 8
# Pixels between those that are looked at for black and saturated ones.
_STRIDE = 4


@dataclass
class Frames:
    """What a pass over the frames of a recording finds.

    Attributes:
        stamps_ns: of all frames looked at, as recorded.
        refusals: the frames that a run would refuse.
        encodings: encoding of the images -> count; file suffix for folders.
        n_decoded: frames of which the pixels were looked at.
        sizes_px: largest side of the box about the given mask, by stamp.
        found_px: likewise about the mask that Stage 1 finds, without any of its past; empty where masks are given.
        black: share of black pixels of each frame.
        saturated: share of pixels with a saturated channel of each frame.
        shown: (H, W, 3) first, middle and last of the frames that can be used.
    """

    stamps_ns: list[int] = field(default_factory=list)
    refusals: Refusals = field(default_factory=Refusals)
    encodings: Counter[str] = field(default_factory=Counter)
    n_decoded: int = 0
    sizes_px: dict[int, float] = field(default_factory=dict)
    found_px: dict[int, float] = field(default_factory=dict)
    black: list[float] = field(default_factory=list)
    saturated: list[float] = field(default_factory=list)
    shown: list[UInt8] = field(default_factory=list)


def read_frames(
    source: Source, limit: int | None = None, most: int | None = None, segmentation: SegmentationStage | None = None
) -> Frames:
    """Admit the frames as a run does, and decode them.

    Args:
        source: the recording.
        limit: look at so many frames at most, the first ones; None = all.
        most: decode so many of them at most, evenly spread; stamps and encodings are those of all. None = all.
        segmentation: finds the target in a few frames where no masks are given.

    Raises:
        InputError: the recording is damaged, or a file of it cannot be read.
    """
    out, recording = Frames(), source.recording
    if isinstance(recording, BagReader):
        out.stamps_ns = [packet.stamp_ns for packet in islice(recording.packets(), limit)]
        images = islice(recording.messages(recording.image_topic), limit)
        out.encodings.update(str(m.format if recording.compressed else m.encoding) for m in images)
    else:
        out.stamps_ns = [item.stamp_ns for item in recording.files[:limit]]
        out.encodings.update(item.image.suffix for item in recording.files[:limit])
    total = len(out.stamps_ns)
    chosen = _spread(total, total if most is None else most)
    segmented = _spread(total, _SEGMENTED) if segmentation is not None else set()
    segmented = {min(chosen, key=lambda number: abs(number - wanted)) for wanted in segmented}
    wanted, last = [0, total // 2], None
    for index, frame in _admitted(out, source, chosen):
        _measure(out, frame)
        if segmentation is not None and index in segmented and frame.given_mask is None:
            segmentation.reset()
            found = segmentation.update(frame, None)
            if found is not None:
                out.found_px[frame.stamp_ns] = _largest_side_px(found.mask)
        last = frame.rgb
        if wanted and index >= wanted[0]:
            out.shown.append(frame.rgb)
            wanted.pop(0)
    out.shown += [] if last is None else [last]
    return out


def _spread(total: int, most: int) -> set[int]:
    """So many numbers below ``total`` at most, evenly spread, the first and the last among them."""
    return set(np.linspace(0, total - 1, min(total, most)).round().astype(int).tolist())


def _admitted(out: Frames, source: Source, chosen: set[int]) -> Iterator[tuple[int, Frame]]:
    """Number and frame of those that are decoded and may enter; what is refused is counted, by its stamp alone too."""
    admission, decoded = Admission(1), source.frames_at(chosen)
    for index, stamp_ns in enumerate(out.stamps_ns):
        frame = None
        if index in chosen:
            found = next(decoded)
            out.n_decoded += 1
            if isinstance(found, FrameError):
                out.refusals.add(str(found))
                continue
            frame = found
        try:
            admission.admit(stamp_ns)
        except FrameError as error:
            out.refusals.add(f"frame {stamp_ns}: {error}")
            continue
        admission.answered(stamp_ns)
        if frame is not None:
            yield index, frame


def _measure(out: Frames, frame: Frame) -> None:
    pixels = frame.rgb[::_STRIDE, ::_STRIDE].max(axis=2)
    out.black.append(float((pixels == 0).mean()))
    out.saturated.append(float((pixels == 255).mean()))
    if frame.given_mask is not None and frame.given_mask.any():
        out.sizes_px[frame.stamp_ns] = _largest_side_px(frame.given_mask)


def _largest_side_px(mask: NDArray[np.generic]) -> float:
    """Of the box about an (H, W) mask that is not empty."""
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return float(max(rows[-1] - rows[0], cols[-1] - cols[0]) + 1)
