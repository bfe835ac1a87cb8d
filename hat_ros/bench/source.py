"""What a run is made from: a bag, a clip of the ``sequence`` layout, or one sequence of a data set as published."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from hat_ros.array_types import Float, UInt8
from hat_ros.bench.datasets.image_files import ImageRecording
from hat_ros.bench.datasets.importer import open_dataset, with_annotation_boxes, with_detections
from hat_ros.bench.datasets.protocols import NONE, protocol_of
from hat_ros.bench.datasets.sequence import load_sequence
from hat_ros.config import CameraConfig
from hat_ros.errors import BagError, DatasetError, FrameError, UsageError
from hat_ros.geometry import lie
from hat_ros.io.bag_files import is_bag
from hat_ros.io.bag_reader import BagReader, Packet
from hat_ros.io.provenance import input_hash
from hat_ros.target.loading import load_target
from hat_ros.target.mesh_file import companions_of
from hat_ros.target.model import Target
from hat_ros.types import Frame


@dataclass(frozen=True)
class SourceSpec:
    """Where a recording is.

    Attributes:
        path: bag, sequence folder, or root folder of a data set.
        dataset: layout of the data set (``spark``, ``shirt``, ...); empty = ``path`` is one recording.
        sequence: name of the sequence within the data set.
        model: CAD model, for data sets that bring none.
        detections: masks or boxes of this sequence computed elsewhere, see ``datasets.importer.with_detections``.
        image_topic: topic of the images in a bag; None = find it.
        camera_info_topic: topic of the calibration in a bag; None = find it.
        published: read the data set by its published protocol (:mod:`hat_ros.bench.datasets.protocols`).
    """

    path: Path
    dataset: str = ""
    sequence: str = ""
    model: Path | None = None
    detections: Path | None = None
    image_topic: str | None = None
    camera_info_topic: str | None = None
    published: bool = False

    @property
    def name(self) -> str:
        """Name for tables and folders."""
        return (self.sequence if self.dataset else self.path.resolve().name).replace("/", "_")

    @property
    def group(self) -> str:
        """What it belongs to: the data set, or the folder that it lies in."""
        return self.dataset or self.path.resolve().parent.name

    def sha256(self) -> str:
        """Digest of everything that the recording is made of."""
        if not self.dataset:
            return self._with_detections(input_hash(self.path))
        recording = self._in_dataset()
        digest = hashlib.sha256(recording.camera.K.tobytes() + recording.distortion.tobytes())
        if recording.targets_only:
            digest.update(b"targets only")
        for item in recording.files:
            truth = b"" if item.T_cam_target is None else item.T_cam_target.tobytes()
            box = b"" if item.box_xyxy is None else np.asarray(item.box_xyxy, dtype=np.float64).tobytes()
            digest.update(b"\0".join((str(item.stamp_ns).encode(), truth, box)))
            for path in (item.image, *item.masks):
                digest.update(input_hash(path).encode())
        model = recording.model_file()
        for path in dict.fromkeys((recording.target_path, model.mesh, *companions_of(model.mesh).values())):
            digest.update(input_hash(path).encode())
        return self._with_detections(digest.hexdigest())

    def _with_detections(self, rest: str) -> str:
        if self.detections is None:
            return rest
        return hashlib.sha256(f"{rest}{input_hash(self.detections)}".encode()).hexdigest()

    def describe(self) -> dict[str, str | None]:
        """What ``run.json`` says about where it is, beside ``source`` itself."""
        return {
            "dataset": self.dataset,
            "sequence": self.sequence,
            "model": None if self.model is None else str(self.model.resolve()),
            "detections": None if self.detections is None else str(self.detections.resolve()),
            "detections_sha256": None if self.detections is None else input_hash(self.detections),
            "image_topic": self.image_topic,
            "camera_info_topic": self.camera_info_topic,
            "protocol": "published" if self.published else "none",
        }

    def open(self, camera_config: CameraConfig | None = None) -> Source:
        """Open the recording and its CAD model.

        Args:
            camera_config: what the messages of a bag do not say of the camera; None = find out.

        Raises:
            UsageError: there is nothing of that name, or it is no recording.
            InputError: it is malformed, or no CAD model lies beside it.
        """
        if self.dataset:
            return _source_of_images(self.path, self._in_dataset(), camera_config)
        return open_source(
            self.path,
            self.detections,
            camera_config,
            image_topic=self.image_topic,
            camera_info_topic=self.camera_info_topic,
        )

    def _in_dataset(self) -> ImageRecording:
        protocol = protocol_of(self.dataset) if self.published else NONE
        for recording in open_dataset(self.dataset, self.path, self.model, (self.sequence,)):
            recording = protocol.read(recording)
            if self.detections is not None:
                return with_detections(recording, self.detections)
            # SHIRT has neither masks nor a published detector: the paper takes the regions from the labels.
            return with_annotation_boxes(recording, protocol.corner_boxes) if self.dataset == "shirt" else recording
        raise DatasetError(f"{self.path}: no sequence named {self.sequence}")


@dataclass(frozen=True)
class Source:
    """A recording that was opened, with its target."""

    path: Path
    recording: ImageRecording | BagReader
    target: Target

    def frames(
        self, start: int = 0, limit: int | None = None, masks: bool = True, scored_only: bool = False
    ) -> Iterator[Frame | FrameError]:
        """Frames from number ``start`` on, at most ``limit`` of them; a malformed one comes as its error.

        ``masks``: with the recorded ones. ``scored_only``: those alone of these at which a pose is asked for.
        """
        stop, recording = None if limit is None else start + limit, self.recording
        if isinstance(recording, BagReader):
            return _attempts(recording, islice(recording.packets(), start, stop), masks)
        if scored_only and recording.targets_only:
            files = [item for item in recording.files[start:stop] if recording.is_scored(item)]
            return replace(recording, files=files).frames(masks=masks)
        return recording.frames(stop, masks, start)

    def frames_at(self, numbers: Collection[int]) -> Iterator[Frame | FrameError]:
        """The frames of these numbers alone, in order, with masks; a malformed one comes as its error."""
        recording = self.recording
        if isinstance(recording, BagReader):
            chosen = (packet for number, packet in enumerate(recording.packets()) if number in numbers)
            return _attempts(recording, chosen, masks=True)
        return replace(recording, files=[recording.files[number] for number in sorted(numbers)]).frames()

    def masks(self, start: int = 0, limit: int | None = None) -> Iterator[tuple[int, UInt8 | None]]:
        """Stamps and recorded masks of the same frames, images left alone."""
        recording, stop = self.recording, None if limit is None else start + limit
        if isinstance(recording, BagReader):
            return islice(_masks(recording), start, stop)
        return ((item.stamp_ns, recording.given_mask(item)) for item in recording.files[start:stop])

    def count(self, start: int = 0, limit: int | None = None) -> int:
        """How many frames :meth:`frames` brings."""
        rest = max(0, len(self.recording) - start)
        return rest if limit is None else min(rest, limit)

    @property
    def frame_id(self) -> str:
        """``header.frame_id`` of the images."""
        return self.recording.frame_id if isinstance(self.recording, BagReader) else "camera"

    def truth_rows(self) -> dict[int, Float]:
        """Stamp -> true pose row (7,), empty when unknown."""
        if isinstance(self.recording, BagReader):
            return self.recording.truth_rows()
        return {stamp: lie.row_from_matrix(T) for stamp, T in self.recording.truth().items()}


def _attempts(bag: BagReader, packets: Iterable[Packet], masks: bool) -> Iterator[Frame | FrameError]:
    """These frames of a bag; one that cannot be decoded does not end the stream. Those left out are not looked at."""
    decoder = bag.decoder()
    for packet in packets:
        try:
            frame = bag.decoded(packet, decoder, masks)
        except FrameError as error:
            yield FrameError(f"frame {packet.stamp_ns}: {error}")
            continue
        yield frame


def _masks(bag: BagReader) -> Iterator[tuple[int, UInt8 | None]]:
    """Stamps and masks of a bag; None for one that cannot be decoded."""
    decoder = bag.decoder()
    for packet in bag.packets():
        mask = None
        with suppress(FrameError):
            mask = bag.decoded_mask(packet, decoder)
        yield packet.stamp_ns, mask


def open_source(
    path: str | Path,
    detections: Path | None = None,
    camera_config: CameraConfig | None = None,
    *,
    image_topic: str | None = None,
    camera_info_topic: str | None = None,
) -> Source:
    """Open a bag or a folder of the ``sequence`` layout, and the CAD model beside it; see :meth:`SourceSpec.open`."""
    path = Path(path)
    if not path.exists():
        raise UsageError(f"recording {path}: no such file or folder")
    if not path.is_dir() and not path.is_file():
        raise UsageError(f"recording {path}: is neither a file nor a folder (a pipe or a device?)")
    if (path / "labels.json").is_file():
        recording = load_sequence(path)
        return _source_of_images(
            path, recording if detections is None else with_detections(recording, detections), camera_config
        )
    if not is_bag(path):
        raise UsageError(
            f"recording {path}: neither a bag (metadata.yaml, .mcap or .db3) nor a sequence folder (labels.json)"
        )
    if detections is not None:
        raise UsageError(f"recording {path}: a bag has its detections in it; give --detections to `hat import`")
    bag = BagReader(path, image_topic=image_topic, camera_info_topic=camera_info_topic, camera_config=camera_config)
    if bag.target_path is None:
        raise BagError(f"{path} has no target.yaml: put the CAD model and a target.yaml that names it into the folder")
    return Source(path, bag, load_target(bag.target_path))


def _source_of_images(path: Path, recording: ImageRecording, camera_config: CameraConfig | None) -> Source:
    if camera_config is not None:
        recording = replace(recording, image_depth=camera_config.image_depth)
    return Source(path, recording, recording.load_target())
