"""All message encoding: stage types <-> ROS messages, byte for byte, and nothing else (DESIGN section 4).

Tables are PointCloud2 with named little-endian FLOAT64 columns: the one common message that is atomic, stamped and
exact. Names, order, types and sizes are checked; anything else is a :class:`~hat_ros.errors.WireError`.

Decoders take any object with the message's attributes, so they serve rclpy's messages and those that ``rosbags`` reads
alike; this module imports neither. :class:`Wire` encodes into either family.
"""

from __future__ import annotations

import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from hat_ros.array_types import Float, UInt8
from hat_ros.errors import FrameError, HatError, WireError
from hat_ros.io import images, topics
from hat_ros.types import Alignment, Camera, Candidates, Detection, Estimate, Motion, Selection, TrackState

_FLOAT64 = 8
_NS_PER_S = 1_000_000_000
_MAX_SEC = 2**31
_EXACT_INT = 2.0**53


def stamp_of(message: Any) -> int:
    """Stamp of a message's header in nanoseconds.

    Raises:
        WireError: the nanoseconds field is out of range.
    """
    stamp = message.header.stamp
    if not 0 <= stamp.nanosec < _NS_PER_S:
        raise WireError(f"header.stamp.nanosec must be below 1e9, found {stamp.nanosec}")
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


@dataclass(frozen=True)
class Admitted:
    """The record of entry of one frame, ``/hat/admission``: a stage knows from it what comes in which order.

    Attributes:
        seq: number of the frame since the start of the run, from 0.
        dropped_total: frames not admitted so far (live drops, rejected stamps or images).
        epoch: counts resets of the graph; a new one tells every stage to start afresh at this frame.
    """

    seq: int
    dropped_total: int
    epoch: int


@dataclass(frozen=True)
class Status:
    """One row of ``/hat/status``: the estimate (without covariance and alignment) and its place in the run."""

    estimate: Estimate
    seq: int
    dropped_total: int
    alignment_version: int


class Wire:
    """Encodes stage types into messages.

    Args:
        message_class: full type name (``sensor_msgs/msg/Image``) -> message class, taking keyword arguments.
        octets: bytes-like -> what the family wants in a ``uint8[]`` field.
        numbers: floats -> what the family wants in a ``float64[]`` field.
    """

    def __init__(
        self,
        message_class: Callable[[str], type],
        octets: Callable[[Any], Any],
        numbers: Callable[[Sequence[float]], Any],
    ) -> None:
        self._class = message_class
        self._octets = octets
        self._numbers = numbers
        self._fields: dict[tuple[str, ...], list[Any]] = {}

    @classmethod
    def ros(cls) -> Wire:
        """For rclpy; ``uint8[]`` fields are ``array.array`` because rclpy copies that one whole."""

        def octets(data: Any) -> array.array:
            out = array.array("B")
            out.frombytes(data)
            return out

        return cls(message_class, octets, lambda values: array.array("d", values))

    @classmethod
    def bag(cls, typestore: Any) -> Wire:
        """For ``rosbags``' messages of a typestore."""
        return cls(
            typestore.types.__getitem__,
            lambda data: np.frombuffer(data, dtype=np.uint8),
            lambda values: np.array(values, dtype=np.float64),
        )

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """std_msgs/Header."""
        sec, nanosec = divmod(int(stamp_ns), _NS_PER_S)
        if not -_MAX_SEC <= sec < _MAX_SEC:
            raise FrameError(f"stamp {stamp_ns} ns does not fit a ROS time stamp (32 bit seconds)")
        stamp = self._class("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)
        return self._class("std_msgs/msg/Header")(stamp=stamp, frame_id=frame_id)

    # ---------------------------------------------------------------- tables

    def table(self, stamp_ns: int, frame_id: str, columns: tuple[str, ...], rows: Float) -> Any:
        """PointCloud2 of (N, C) float64 rows."""
        rows = np.ascontiguousarray(rows, dtype="<f8").reshape(-1, len(columns))
        return self._class("sensor_msgs/msg/PointCloud2")(
            header=self.header(stamp_ns, frame_id),
            height=1,
            width=len(rows),
            fields=self._point_fields(columns),
            is_bigendian=False,
            point_step=8 * len(columns),
            row_step=8 * len(columns) * len(rows),
            data=self._octets(rows.tobytes()),
            is_dense=bool(np.isfinite(rows).all()),
        )

    def _point_fields(self, columns: tuple[str, ...]) -> list[Any]:
        if columns not in self._fields:
            field = self._class("sensor_msgs/msg/PointField")
            self._fields[columns] = [
                field(name=name, offset=8 * i, datatype=_FLOAT64, count=1) for i, name in enumerate(columns)
            ]
        return list(self._fields[columns])

    def admission(self, stamp_ns: int, frame_id: str, admitted: Admitted) -> Any:
        """Table of ``/hat/admission``."""
        row = np.array([[admitted.seq, admitted.dropped_total, admitted.epoch]], dtype=np.float64)
        return self.table(stamp_ns, frame_id, topics.ADMISSION_COLUMNS, row)

    def candidates(self, stamp_ns: int, frame_id: str, candidates: Candidates) -> Any:
        """Table of ``/hat/hypotheses_scored``."""
        return self.table(stamp_ns, frame_id, topics.CANDIDATE_COLUMNS, _candidate_rows(candidates))

    def selection(self, stamp_ns: int, frame_id: str, selection: Selection) -> Any:
        """Table of ``/hat/selection``."""
        selected = (np.arange(len(selection.candidates)) == selection.selected).astype(np.float64)
        rows = np.column_stack(
            [_candidate_rows(selection.candidates), selection.scaled_score, selection.path_score, selected]
        )
        return self.table(stamp_ns, frame_id, topics.SELECTION_COLUMNS, rows)

    def motion(self, stamp_ns: int, frame_id: str, motion: Motion) -> Any:
        """Table of ``/hat/slam_state``."""
        row = np.concatenate([[motion.valid, motion.epoch], motion.pose_row, [motion.n_keyframes]])
        return self.table(stamp_ns, frame_id, topics.MOTION_COLUMNS, row)

    def alignment(self, stamp_ns: int, frame_id: str, alignment: Alignment) -> Any:
        """Table of ``/hat/alignment``."""
        a = alignment
        row = np.concatenate([[a.version, a.scale], a.quat_xyzw, a.translation_m, [a.n_anchors, a.rms, a.epoch]])
        return self.table(stamp_ns, frame_id, topics.ALIGNMENT_COLUMNS, row)

    def status(self, frame_id: str, estimate: Estimate, admitted: Admitted) -> Any:
        """Table of ``/hat/status``."""
        e = estimate
        version = 0 if e.alignment is None else e.alignment.version
        head = [e.state, admitted.seq, e.keyframe, e.n_candidates, e.anchor, e.gate_weight]
        tail = [version, e.slam_epoch, e.gap_frames, admitted.dropped_total]
        row = np.concatenate([head, tail, e.pose_row])
        return self.table(e.stamp_ns, frame_id, topics.STATUS_COLUMNS, row)

    # ---------------------------------------------------------------- images

    def camera_info(self, stamp_ns: int, frame_id: str, camera: Camera) -> Any:
        """CameraInfo of a camera without distortion."""
        K = camera.K
        roi = self._class("sensor_msgs/msg/RegionOfInterest")(
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._class("sensor_msgs/msg/CameraInfo")(
            header=self.header(stamp_ns, frame_id),
            height=int(camera.height),
            width=int(camera.width),
            distortion_model="plumb_bob",
            d=self._numbers([0.0] * 5),
            k=K.ravel().copy(),
            r=np.eye(3).ravel(),
            p=np.column_stack([K, np.zeros(3)]).ravel(),
            binning_x=0,
            binning_y=0,
            roi=roi,
        )

    def image(self, stamp_ns: int, frame_id: str, encoding: str, pixels: UInt8) -> Any:
        """Image of (H, W) or (H, W, C) uint8 pixels."""
        pixels = np.ascontiguousarray(pixels)
        return self._class("sensor_msgs/msg/Image")(
            header=self.header(stamp_ns, frame_id),
            height=int(pixels.shape[0]),
            width=int(pixels.shape[1]),
            encoding=encoding,
            is_bigendian=0,
            step=int(pixels[0].size) if len(pixels) else 0,
            data=self._octets(memoryview(pixels).cast("B") if pixels.size else b""),
        )

    def compressed(self, stamp_ns: int, frame_id: str, image_format: str, data: bytes) -> Any:
        """CompressedImage."""
        return self._class("sensor_msgs/msg/CompressedImage")(
            header=self.header(stamp_ns, frame_id), format=image_format, data=self._octets(data)
        )

    def frame(self, stamp_ns: int, frame_id: str, rgb: UInt8, detection: Detection | None) -> Any:
        """Image of ``/hat/frame``: rgba8, alpha = mask, see :func:`hat_ros.io.images.rgba_from`."""
        return self.image(stamp_ns, frame_id, "rgba8", images.rgba_from(rgb, detection))

    # ---------------------------------------------------------------- poses

    def _pose(self, row: Float) -> Any:
        x, y, z, qx, qy, qz, qw = (float(value) for value in row)
        return self._class("geometry_msgs/msg/Pose")(
            position=self._class("geometry_msgs/msg/Point")(x=x, y=y, z=z),
            orientation=self._class("geometry_msgs/msg/Quaternion")(x=qx, y=qy, z=qz, w=qw),
        )

    def pose(self, stamp_ns: int, frame_id: str, pose_row: Float) -> Any:
        """PoseStamped."""
        return self._class("geometry_msgs/msg/PoseStamped")(
            header=self.header(stamp_ns, frame_id), pose=self._pose(pose_row)
        )

    def pose_with_covariance(self, stamp_ns: int, frame_id: str, pose_row: Float, covariance: Float) -> Any:
        """PoseWithCovarianceStamped; both sides order the covariance as translation, then rotation about x, y, z."""
        return self._class("geometry_msgs/msg/PoseWithCovarianceStamped")(
            header=self.header(stamp_ns, frame_id), pose=self._with_covariance(pose_row, covariance)
        )

    def _with_covariance(self, pose_row: Float, covariance: Float) -> Any:
        values = np.asarray(covariance, dtype=np.float64).ravel().copy()
        return self._class("geometry_msgs/msg/PoseWithCovariance")(pose=self._pose(pose_row), covariance=values)

    def pose_array(self, stamp_ns: int, frame_id: str, pose_rows: Float) -> Any:
        """PoseArray, in the order of the rows."""
        return self._class("geometry_msgs/msg/PoseArray")(
            header=self.header(stamp_ns, frame_id), poses=[self._pose(row) for row in pose_rows]
        )

    def odometry(self, stamp_ns: int, camera_frame_id: str, motion: Motion) -> Any:
        """Odometry of the camera in ``slam_<epoch>``, unscaled.

        Only the rotation has a stated uncertainty (``Motion.sigma_rad``); -1 in the first element of a covariance means
        "unknown" by ROS convention, so the translation has a variance of its own gauge: unknown scale, 1e6.
        """
        covariance = np.zeros((6, 6))
        if np.isfinite(motion.sigma_rad):
            np.fill_diagonal(covariance, [1e6] * 3 + [motion.sigma_rad**2] * 3)
        else:
            covariance[0, 0] = -1.0
        vector = self._class("geometry_msgs/msg/Vector3")
        twist = self._class("geometry_msgs/msg/Twist")(
            linear=vector(x=0.0, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0)
        )
        unknown = np.zeros(36)
        unknown[0] = -1.0
        return self._class("nav_msgs/msg/Odometry")(
            header=self.header(stamp_ns, f"slam_{motion.epoch}"),
            child_frame_id=camera_frame_id,
            pose=self._with_covariance(motion.pose_row, covariance),
            twist=self._class("geometry_msgs/msg/TwistWithCovariance")(twist=twist, covariance=unknown),
        )

    def transform(self, stamp_ns: int, frame_id: str, child_frame_id: str, pose_row: Float) -> Any:
        """TransformStamped."""
        x, y, z, qx, qy, qz, qw = (float(value) for value in pose_row)
        return self._class("geometry_msgs/msg/TransformStamped")(
            header=self.header(stamp_ns, frame_id),
            child_frame_id=child_frame_id,
            transform=self._class("geometry_msgs/msg/Transform")(
                translation=self._class("geometry_msgs/msg/Vector3")(x=x, y=y, z=z),
                rotation=self._class("geometry_msgs/msg/Quaternion")(x=qx, y=qy, z=qz, w=qw),
            ),
        )

    def diagnostics(self, stamp_ns: int, name: str, level: int, text: str, values: dict[str, Any]) -> Any:
        """DiagnosticArray with one status; ``level`` is 0 OK, 1 WARN, 2 ERROR."""
        key_value = self._class("diagnostic_msgs/msg/KeyValue")
        status = self._class("diagnostic_msgs/msg/DiagnosticStatus")(
            level=bytes([level]),
            name=name,
            message=text,
            hardware_id="",
            values=[key_value(key=key, value=str(value)) for key, value in values.items()],
        )
        return self._class("diagnostic_msgs/msg/DiagnosticArray")(header=self.header(stamp_ns, ""), status=[status])


@cache
def message_class(name: str) -> type:
    """rclpy's class of a full type name, ``package/msg/Name``."""
    package, kind, short = name.split("/")
    return getattr(import_module(f"{package}.{kind}"), short)


def _candidate_rows(candidates: Candidates) -> Float:
    n = len(candidates)
    boxes = np.broadcast_to(candidates.box_xyxy, (n, 4))
    return np.column_stack([candidates.pose_rows, candidates.log_score, np.arange(n, dtype=np.float64), boxes])


# -------------------------------------------------------------------- decoding


def read_table(message: Any, columns: tuple[str, ...]) -> Float:
    """(N, C) float64 rows of a table message.

    Raises:
        WireError: names, order, types, sizes or byte order are not exactly those promised.
    """
    names = tuple(field.name for field in message.fields)
    if names != columns:
        raise WireError(f"table columns must be {' '.join(columns)}, found {' '.join(names) or 'none'}")
    for i, field in enumerate(message.fields):
        if (field.offset, field.datatype, field.count) != (8 * i, _FLOAT64, 1):
            raise WireError(
                f"table column '{field.name}' must be one FLOAT64 at offset {8 * i}, found datatype {field.datatype}, "
                f"count {field.count}, offset {field.offset}"
            )
    step, n = 8 * len(columns), message.width
    if message.is_bigendian or message.height != 1 or message.point_step != step or message.row_step != step * n:
        raise WireError(
            f"table must be little-endian, height 1, point_step {step}, row_step {step * n}; found bigendian "
            f"{bool(message.is_bigendian)}, height {message.height}, point_step {message.point_step}, "
            f"row_step {message.row_step}"
        )
    if len(message.data) != step * n:
        raise WireError(f"table of {n} rows must hold {step * n} bytes, found {len(message.data)}")
    return np.frombuffer(message.data, dtype="<f8").reshape(n, len(columns)).astype(np.float64)


def _one_row(message: Any, columns: tuple[str, ...]) -> dict[str, float]:
    rows = read_table(message, columns)
    if len(rows) != 1:
        raise WireError(f"table must have one row, found {len(rows)}")
    return dict(zip(columns, rows[0].tolist(), strict=True))


def _int(name: str, value: float, low: int = 0) -> int:
    if not (low <= value < _EXACT_INT) or value != int(value):
        raise WireError(f"column '{name}' must be a whole number from {low}, found {value}")
    return int(value)


def _flag(name: str, value: float) -> bool:
    if value not in (0.0, 1.0):
        raise WireError(f"column '{name}' must be 0 or 1, found {value}")
    return value == 1.0


def _check_poses(pose_rows: Float) -> None:
    finite = np.isfinite(pose_rows).all(axis=-1)
    norm = np.linalg.norm(np.where(finite[..., None], pose_rows, 0.0)[..., 3:], axis=-1)
    bad = ~finite | (np.abs(norm - 1.0) > 1e-6)
    if bad.any():
        row = pose_rows.reshape(-1, 7)[int(np.argmax(bad.ravel()))]
        raise WireError(f"a pose must be finite with a unit quaternion, found {row.tolist()}")


def admitted_from(message: Any) -> Admitted:
    """Decode ``/hat/admission``."""
    row = _one_row(message, topics.ADMISSION_COLUMNS)
    return Admitted(*(_int(name, row[name]) for name in topics.ADMISSION_COLUMNS))


def _candidates_from_rows(rows: Float) -> Candidates:
    if not len(rows):
        return Candidates.none()
    pose_rows, score, rank, boxes = rows[:, :7].copy(), rows[:, 7].copy(), rows[:, 8], rows[:, 9:13]
    if not np.array_equal(rank, np.arange(len(rows))):
        raise WireError(f"column 'rank' must count from 0, found {rank.tolist()}")
    if not np.array_equal(boxes, np.broadcast_to(boxes[0], boxes.shape), equal_nan=True):
        raise WireError("columns bx0 by0 bx1 by1 must be the same in all rows of one frame")
    if np.isnan(score).any() or np.isposinf(score).any():
        raise WireError(f"column 'score' must be a number or -inf, found {score.tolist()}")
    _check_poses(pose_rows[np.isfinite(score)])  # a dropped candidate keeps its slot, whatever is in it
    return Candidates(pose_rows, score, boxes[0].copy())


def candidates_from(message: Any) -> Candidates:
    """Decode ``/hat/hypotheses_scored``."""
    return _candidates_from_rows(read_table(message, topics.CANDIDATE_COLUMNS))


def selection_from(message: Any) -> Selection:
    """Decode ``/hat/selection``."""
    rows = read_table(message, topics.SELECTION_COLUMNS)
    candidates = _candidates_from_rows(rows)
    flags = rows[:, 15]
    if not np.isin(flags, (0.0, 1.0)).all() or flags.sum() > 1:
        raise WireError(f"column 'selected' must be 0 with at most one 1, found {flags.tolist()}")
    return Selection(candidates, rows[:, 13].copy(), rows[:, 14].copy(), int(np.argmax(flags)) if flags.any() else -1)


def motion_from(message: Any) -> Motion:
    """Decode ``/hat/slam_state``; ``sigma_rad`` is for people and does not travel here."""
    row = _one_row(message, topics.MOTION_COLUMNS)
    pose_row = np.array([row[name] for name in topics.POSE_COLUMNS])
    valid = _flag("valid", row["valid"])
    if valid:
        _check_poses(pose_row)
    return Motion(valid, _int("epoch", row["epoch"]), pose_row, _int("n_keyframes", row["n_keyframes"]))


def alignment_from(message: Any) -> Alignment:
    """Decode ``/hat/alignment``."""
    row = _one_row(message, topics.ALIGNMENT_COLUMNS)
    if not (np.isfinite(row["scale"]) and row["scale"] > 0):
        raise WireError(f"column 'scale' must be positive, found {row['scale']}")
    quat_xyzw = np.array([row[name] for name in ("qx", "qy", "qz", "qw")])
    translation_m = np.array([row[name] for name in ("tx", "ty", "tz")])
    _check_poses(np.concatenate([translation_m, quat_xyzw]))
    return Alignment(
        _int("version", row["version"], low=1),
        row["scale"],
        quat_xyzw,
        translation_m,
        _int("n_anchors", row["n_anchors"]),
        row["rms"],
        _int("epoch", row["epoch"]),
    )


def status_from(message: Any) -> Status:
    """Decode ``/hat/status``; covariance and alignment have topics of their own."""
    row = _one_row(message, topics.STATUS_COLUMNS)
    state = _int("state", row["state"])
    if state not in iter(TrackState):
        raise WireError(f"column 'state' must be 0 to 3, found {state}")
    pose_row = np.array([row[name] for name in topics.POSE_COLUMNS])
    if TrackState(state).has_pose:
        _check_poses(pose_row)
    estimate = Estimate(
        stamp_of(message),
        TrackState(state),
        pose_row,
        np.full((6, 6), np.nan),
        keyframe=_flag("keyframe", row["keyframe"]),
        n_candidates=_int("n_candidates", row["n_candidates"]),
        anchor=_int("anchor", row["anchor"], low=-1),
        gate_weight=row["gate_weight"],
        slam_epoch=_int("slam_epoch", row["slam_epoch"]),
        gap_frames=_int("gap_frames", row["gap_frames"]),
    )
    return Status(
        estimate,
        _int("seq", row["seq"]),
        _int("dropped_total", row["dropped_total"]),
        _int("alignment_version", row["alignment_version"]),
    )


def pose_row_from(pose: Any) -> Float:
    """(7,) row of a geometry_msgs/Pose, as it stands."""
    p, q = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w], dtype=np.float64)


def camera_from(message: Any) -> Camera:
    """Decode a CameraInfo.

    Raises:
        FrameError: lens distortion, binning or a region of interest, or an impossible matrix.
    """
    d = np.asarray(message.d, dtype=np.float64)
    if d.size and (not np.isfinite(d).all() or d.any()):
        raise FrameError(f"camera_info.d must be zero, found {d.tolist()}: rectify first and use image_rect")
    if message.binning_x > 1 or message.binning_y > 1 or message.roi.width or message.roi.height:
        raise FrameError("camera_info has binning or a region of interest: give the calibration of the image as it is")
    return Camera(np.array(message.k, dtype=np.float64).reshape(3, 3), int(message.width), int(message.height))


def same_camera(a: Camera | None, b: Camera | None) -> bool:
    """Whether two calibrations are identical."""
    if a is None or b is None:
        return a is b
    return np.array_equal(a.K, b.K) and (a.width, a.height) == (b.width, b.height)


def frame_from(message: Any) -> tuple[UInt8, Detection | None]:
    """Decode ``/hat/frame``: (H, W, 3) uint8 and the detection.

    Raises:
        WireError: not rgba8, or alpha is no mask.
    """
    try:
        if message.encoding != "rgba8":
            raise WireError(f"encoding must be rgba8, found '{message.encoding}'")
        return images.split_rgba(images.pixels_of(message, 4))
    except HatError as error:
        raise WireError(f"/hat/frame: {error}") from None
