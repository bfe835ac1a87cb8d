"""What a recording and its CAD model are, told before a run as lines of a table. No pose is estimated."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from hat_ros.array_types import Float, Int
from hat_ros.bench.check_frames import Frames
from hat_ros.bench.datasets.image_files import ImageRecording
from hat_ros.bench.source import Source
from hat_ros.errors import BagError, FrameError
from hat_ros.geometry import lie
from hat_ros.io import topics
from hat_ros.io.bag_files import bag_files
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.manifest import MANIFEST
from hat_ros.io.topic_choice import CAMERA_INFO_KIND, COMPRESSED_KIND, IMAGE_KIND
from hat_ros.target.exact_symmetry import symmetry_of
from hat_ros.target.loading import find_model
from hat_ros.target.model import Target
from hat_ros.target.symmetry import near_symmetries
from hat_ros.types import Camera

# A step of more than so many usual ones is a gap.
_GAP_STEPS = 1.5
# Masks of another size than the CAD model at the true pose, by this factor, are no matter of occlusion.
_UNLIKE = 3.0
_GREY = 160
# Symmetries of larger models take longer than a look should.
_MAX_SYMMETRY_FACES = 100_000

Line = tuple[str, str]


@contextmanager
def notes() -> Iterator[list[Line]]:
    """What the package logs within, as lines ``warning`` or ``note``."""
    lines: list[Line] = []

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(("warning" if record.levelno >= logging.WARNING else "note", record.getMessage()))

    log, handler = logging.getLogger("hat_ros"), Handler()
    before = log.level
    log.setLevel(logging.INFO)
    log.addHandler(handler)
    try:
        yield lines
    finally:
        log.removeHandler(handler)
        log.setLevel(before)


def cad_lines(path: Path, target: Target, unit_scale: float | None = 1.0) -> Iterator[Line]:
    """The CAD model: file, unit, size, faces, colours, symmetries.

    Args:
        path: CAD file or ``target.yaml``, as it was given to :func:`hat_ros.target.loading.load_target`.
        target: what came of it.
        unit_scale: likewise.

    Raises:
        MeshError: see :func:`hat_ros.target.loading.find_model`.
    """
    model = find_model(path, unit_scale)
    yield "CAD file", f"{model.mesh} ({model.mesh.suffix[1:].lower()}), name {model.name}"
    yield "unit scale", f"{model.unit_scale:g} m per unit of the file"
    x, y, z = np.ptp(target.vertices_m, axis=0)
    yield "size", f"{x:.4g} x {y:.4g} x {z:.4g} m (x, y, z), diameter {target.diameter_m:.4g} m"
    low, high = target.vertices_m.min(axis=0), target.vertices_m.max(axis=0)
    yield "origin", "inside its box" if (low <= 0).all() and (high >= 0).all() else "outside its box"
    yield "faces", f"{len(target.faces)}, vertices {len(target.vertices_m)}"
    has_color = bool(
        target.surface.textures or target.surface.corner_rgb is not None or (target.face_rgb != _GREY).any()
    )
    yield "colours", f"yes, {len(target.surface.textures)} textures" if has_color else "none, taken as grey"
    exact = symmetry_of(target)
    how = "found" if target.declared_symmetry is None else "declared"
    yield "symmetry", f"{how}: a pose is {exact.words()}" if exact.words() else f"none {how}"
    if len(target.faces) > _MAX_SYMMETRY_FACES:
        yield "near-symmetries", f"not looked for beyond {_MAX_SYMMETRY_FACES} faces"
        return
    angles = [f"{np.degrees(lie.angle_between(turn, np.eye(3))):.0f} deg" for turn in near_symmetries(target, exact)]
    yield "near-symmetries", f"turns of {', '.join(angles)} hardly change the silhouette" if angles else "none"


def recording_lines(source: Source) -> Iterator[Line]:
    """What a recording is, without its frames: files, topics, calibration, what lies beside the images.

    Raises:
        BagError: the calibration is missing or changes.
        FrameError: it is unusable.
    """
    recording = source.recording
    if isinstance(recording, BagReader):
        yield from _bag_lines(recording)
    else:
        yield from _clip_lines(source.path, recording)
    K, camera = recording.camera.K, recording.camera
    yield "camera matrix", f"fx {K[0, 0]:.2f}, fy {K[1, 1]:.2f}, cx {K[0, 2]:.2f}, cy {K[1, 2]:.2f} px"
    fov = 2 * np.degrees(np.arctan([camera.width / 2 / K[0, 0], camera.height / 2 / K[1, 1]]))
    yield "image size", f"{camera.width} x {camera.height} px, field of view {fov[0]:.1f} x {fov[1]:.1f} deg"
    yield "ground truth", f"{len(source.truth_rows())} poses"


def _bag_lines(bag: BagReader) -> Iterator[Line]:
    yield "recording", f"bag: {', '.join(file.name for file in bag_files(bag.path))}"
    has_manifest = (bag.path / MANIFEST).is_file()
    yield "checksums", f"{MANIFEST} agrees" if has_manifest else "no manifest; those inside MCAP files agree, if any"
    for label, chosen, kinds in (
        ("image topic", bag.image_topic, (IMAGE_KIND, COMPRESSED_KIND)),
        ("camera_info topic", bag.camera_info_topic, (CAMERA_INFO_KIND,)),
    ):
        found = {name for name, kind in bag.topics.items() if kind in kinds} - {chosen, topics.DETECTION_MASK}
        yield label, f"{chosen} (others: {', '.join(sorted(found)) or 'none'})"
    info = next(bag.messages(bag.camera_info_topic), None)
    if info is None:
        raise BagError(f"{bag.path}: topic {bag.camera_info_topic} has no message: the calibration is missing")
    lens, calibration = np.asarray(info.d).tolist(), bag.calibration
    yield "distortion", f"{info.distortion_model or 'no model'}, d = {lens}" if any(lens) else "none"
    yield "rectified", calibration.said or "no choice: camera_info describes one image"
    yield "given masks", bag.mask_topic or "none"


def _clip_lines(path: Path, recording: ImageRecording) -> Iterator[Line]:
    yield "recording", f"folder of images: {path}, {len(recording)} files"
    yield "distortion", f"d = {recording.distortion.tolist()}" if recording.distortion.any() else "none"
    masked = sum(bool(item.masks) or item.box_xyxy is not None for item in recording.files)
    yield "given masks", f"{masked} of {len(recording)} frames"


def frame_lines(found: Frames, source: Source) -> Iterator[Line]:
    """The frames: stamps, refusals, encodings, grey levels, size of the target in them.

    Raises:
        FrameError: a run could use none of them.
    """
    n = len(found.stamps_ns)
    sampled = f"; of {found.n_decoded} of them, evenly spread, the images" if found.n_decoded < n else ""
    yield "frames", f"{n} looked at of {source.count()}, {found.refusals.total} refused{sampled}"
    yield from (("refused", f"{record['count']} x {record['first']}") for record in found.refusals.records())
    yield from _stamp_lines(np.array(found.stamps_ns, dtype=np.int64))
    yield "encoding", ", ".join(f"{name} ({count})" for name, count in found.encodings.items()) or "-"
    if not found.shown:
        raise FrameError(f"{source.path}: no frame can be used: {str(found.refusals) or 'the recording has none'}")
    yield "black pixels", f"{np.mean(found.black):.1%}, at most {np.max(found.black):.1%}"
    yield "saturated pixels", f"{np.mean(found.saturated):.1%}, at most {np.max(found.saturated):.1%}"
    yield from _size_lines(found, source)


def _stamp_lines(stamps_ns: Int) -> Iterator[Line]:
    ordered = np.unique(stamps_ns)
    steps, forward = stamps_ns[1:] - stamps_ns[:-1], 1e-9 * (ordered[1:] - ordered[:-1])
    if not len(forward):
        return
    usual = float(np.median(forward))
    yield "duration", f"{np.ptp(stamps_ns) * 1e-9:.3f} s from {stamps_ns.min()} ns on"
    yield "rate", f"{1 / usual:.3f} Hz, jitter (SD of the steps) {1e3 * forward.std():.3f} ms"
    gaps = forward[forward > _GAP_STEPS * usual]
    yield "gaps", f"{len(gaps)}, the longest {gaps.max():.3f} s" if len(gaps) else "none"
    yield "backward stamps", f"{(steps < 0).sum()}, duplicates {(steps == 0).sum()}"


def _size_lines(found: Frames, source: Source) -> Iterator[Line]:
    camera, target, truth = source.recording.camera, source.target, source.truth_rows()
    rows = {stamp: truth[stamp] for stamp in found.stamps_ns if stamp in truth}
    every = {stamp: _projected_px(row, camera, target) for stamp, row in rows.items()}
    projected = {stamp: size for stamp, size in every.items() if size > 0}
    seen = found.sizes_px or found.found_px
    if not seen and not projected:
        yield "target in the image", "unknown: neither given masks, nor ground truth, nor a mask that Stage 1 finds"
        return
    sizes = found.sizes_px or projected or seen
    origin = "given masks" if found.sizes_px else "ground truth" if projected else "Stage 1 on single frames"
    values = np.array([sizes[stamp] for stamp in sorted(sizes)])
    shown = values[np.linspace(0, len(values) - 1, min(5, len(values))).astype(int)]
    over = ", ".join(f"{value:.0f}" for value in shown)
    yield "target in the image", f"{values.min():.0f} to {values.max():.0f} px, over time {over} px (by {origin})"
    near, far = camera.K[0, 0] * target.diameter_m / np.array([values.max(), values.min()])
    yield "range by size", f"at most {near:.3g} m where it is largest, {far:.3g} m where it is smallest: check the unit"
    ratios = [seen[stamp] / projected[stamp] for stamp in seen if projected.get(stamp)]
    if ratios and not 1 / _UNLIKE <= np.median(ratios) <= _UNLIKE:
        masks, other = ("given masks", "") if found.sizes_px else ("masks that Stage 1 finds", ", or give masks")
        yield (
            "warning",
            f"the {masks} are {np.median(ratios):.3g} times as large as the CAD model at the true poses: check "
            f"unit_scale and the calibration{other}",
        )


def _projected_px(row: Float, camera: Camera, target: Target) -> float:
    """Largest side of the box about the CAD model at a pose row (7,); 0 where some of it is not before the camera."""
    T = lie.matrix_from_row(row)
    points = target.hull_m @ T[:3, :3].T + T[:3, 3]
    return 0.0 if points[:, 2].min() <= 0 else float(np.ptp(camera.project(points), axis=0).max())
