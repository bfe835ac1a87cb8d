"""Messages with fields of any value: calibrations, images, tables of the stages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mutator import mutated
from recording import CAMERA, WIRE, image

from hat_ros.io import messages, topics
from hat_ros.io.calibration import Calibration, calibration_from
from hat_ros.io.frame_decoder import FrameDecoder
from hat_ros.io.image_messages import camera_from, frame_from
from hat_ros.io.images import encode_image
from hat_ros.io.rosbag import TYPESTORE, deserialize

HERE = Path("fuzz")
INFO, IMAGE, PACKED, TABLE = (
    f"sensor_msgs/msg/{name}" for name in ("CameraInfo", "Image", "CompressedImage", "PointCloud2")
)
COUNTS = (0, 1, 2, 3, 29, 30, 39, 40, 41, 80, 120, 160, 240, 65535, 65536, 2**31, 2**32 - 1)
NUMBERS = (0.0, -1.0, 1.0, 60.0, 1e-320, 1e-12, 1e9, 1e200, 1.7e308, -1.7e308, float("nan"), float("inf"))
PLAIN = "rgb8 bgr8 rgba8 bgra8 mono8 mono16 8UC1 8UC3 8UC4 16UC1 16UC3 rgb16 bgr16 32FC1 bayer_rggb8 bayer_gbrg16"
YUV = "yuv422 yuv422_yuy2 uyvy yuyv nv12 nv21 nv24"
ENCODINGS = (
    *PLAIN.split(),
    *YUV.split(),
    *("RGB8", "rgb8;jpeg", "x"),
    "",
    "x" * 5000,
)
FORMATS = (
    "jpeg",
    "png",
    "rgb8; jpeg compressed bgr8",
    "16UC1; compressedDepth",
    "tiff",
    "webp",
    "",
    "h264",
    "y\n" * 2000,
)
TABLES = {
    topics.CANDIDATE_COLUMNS: messages.candidates_from,
    topics.SELECTION_COLUMNS: messages.selection_from,
    topics.MOTION_COLUMNS: messages.motion_from,
    topics.ALIGNMENT_COLUMNS: messages.alignment_from,
    topics.STATUS_COLUMNS: messages.status_from,
    topics.ADMISSION_COLUMNS: messages.admitted_from,
}


def cdr(message, kind, rng):
    """The message as bytes, a fifth of them changed once more."""
    data = bytes(TYPESTORE.serialize_cdr(message, kind))
    return data[:4] + mutated(data[4:], rng) if rng.random() < 0.2 else data


def number(rng):
    return rng.choice(NUMBERS) if rng.random() < 0.5 else rng.uniform(-200, 200)


def test_camera_info(fuzz):
    def make(rng):
        message = WIRE.camera_info(1, "camera", CAMERA)
        for _ in range(rng.choice((0, 1, 2, 4))):
            matrix = getattr(message, rng.choice("kpr"))
            matrix[rng.randrange(len(matrix))] = number(rng)
        if rng.random() < 0.7:
            message.distortion_model = rng.choice(("plumb_bob", "rational_polynomial", "equidistant", "", "z" * 4000))
            small = rng.random() < 0.5
            size = rng.choice((0, 1, 4, 5, 8, 12, 14, 2000))
            message.d = np.array([rng.uniform(-0.3, 0.3) if small else number(rng) for _ in range(size)])
        for _ in range(rng.choice((0, 0, 1, 3))):
            holder, names = rng.choice(
                (
                    (message, ("width", "height", "binning_x", "binning_y")),
                    (message.roi, ("x_offset", "y_offset", "width", "height")),
                )
            )
            setattr(holder, rng.choice(names), rng.choice(COUNTS))
        return bytes([rng.randrange(6)]) + cdr(message, INFO, rng)

    def read(data):
        message = deserialize(data[1:], INFO, HERE)
        topic, rectified = ("/image", "/image_raw", "/image_rect")[data[0] % 3], ("auto", "true")[data[0] // 3]
        found = calibration_from(message, topic, rectified)
        if found is not None and max(found.camera.width, found.camera.height) < 200:
            black = np.zeros((found.camera.height, found.camera.width, 3), np.uint8)
            FrameDecoder(found, "auto", quiet=True).frame(5, WIRE.image(5, "camera", "rgb8", black))
        return camera_from(message)

    fuzz("camera_info", make, read)


def test_images(fuzz):
    def make(rng):
        if rng.random() < 0.25:
            packed = mutated(encode_image(image(0), rng.choice(("png", "jpeg"))), rng)
            return b"c" + cdr(WIRE.compressed(5, "camera", rng.choice(FORMATS), packed), PACKED, rng)
        message = WIRE.image(5, "camera", "rgb8", image(0))
        message.encoding = rng.choice(ENCODINGS)
        message.step = 40 * rng.choice((1, 2, 3, 4, 6, 8))
        message.data = np.frombuffer(rng.randbytes(message.step * 30), np.uint8)
        for _ in range(rng.choice((0, 0, 1, 2))):
            setattr(message, rng.choice(("width", "height", "step")), rng.choice(COUNTS))
        if rng.random() < 0.1:
            message.data = message.data[: rng.randrange(len(message.data) + 1)]
        message.is_bigendian = rng.choice((0, 1, 255))
        return rng.choice((b"i", b"m", b"f")) + cdr(message, IMAGE, rng)

    def read(data):
        decoder = FrameDecoder(Calibration(CAMERA), "auto", quiet=True)
        if data[:1] == b"c":
            return decoder.frame(5, deserialize(data[1:], PACKED, HERE))
        message = deserialize(data[1:], IMAGE, HERE)
        if data[:1] == b"m":
            return decoder.mask(message)
        return frame_from(message) if data[:1] == b"f" else decoder.frame(5, message)

    fuzz("image", make, read)


def test_stage_tables(fuzz):
    def make(rng):
        index = rng.randrange(len(TABLES))
        columns = list(TABLES)[index]
        rows = np.zeros((rng.choice((1, 1, 1, 0, 2, 5)), len(columns)))
        for name, value in (("qw", 1.0), ("scale", 1.0), ("version", 1.0)):
            if name in columns:
                rows[:, columns.index(name)] = value
        if "rank" in columns:
            rows[:, columns.index("rank")] = np.arange(len(rows))
        for _ in range(rng.choice((0, 1, 3)) if rows.size else 0):
            rows.flat[rng.randrange(rows.size)] = number(rng)
        message = WIRE.table(5, "camera", columns, rows)
        if rng.random() < 0.2:
            setattr(message, rng.choice(("width", "height", "point_step", "row_step")), rng.choice(COUNTS))
        if rng.random() < 0.1:
            message.fields[0].name = rng.choice(("", "q" * 3000, "x\ny"))
        return bytes([index]) + cdr(message, TABLE, rng)

    def read(data):
        return list(TABLES.values())[data[0]](deserialize(data[1:], TABLE, HERE))

    fuzz("tables", make, read)
