"""What a ``camera_info`` says of an image: its pinhole camera, and the lens distortion that has to be undone first.

The message describes two images at once: the raw one by K and D, the rectified one by P, both in pixels of the whole
sensor. Which one the image is, no field says. Drivers and ``image_proc`` send the same message with both.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.errors import FrameError
from hat_ros.io.lens import Lens
from hat_ros.types import Camera

# Shares of the focal length. Calibrations that differ by less are one, sent as text or in single precision.
_SAME = 1e-6
# Here K and P say the same: a tenth of a pixel at 1000 px, where one of them was rounded.
_ALIKE = 1e-4
# In a topic's name; "direct", "correct" and "rectangle" say nothing of it.
_RECTIFIED_NAME = re.compile(r"(?<!di)(?<!cor)rect(?!ang)|undist", re.IGNORECASE)
_RAW_NAME = re.compile(r"raw", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class Calibration:
    """One calibration, decided upon.

    Attributes:
        camera: pinhole camera of the frames handed out, and size of the images that come in.
        lens: the distortion of the images that come in, None = they have none.
        said: one sentence for the log: what was chosen where there was a choice; empty where there was none.
    """

    camera: Camera
    lens: Lens | None = None
    said: str = ""

    def is_same(self, other: Calibration) -> bool:
        """Whether two calibrations agree to a millionth."""
        if (self.camera.width, self.camera.height) != (other.camera.width, other.camera.height):
            return False
        if not _close(self.camera.K, other.camera.K, _SAME):
            return False
        if self.lens is None or other.lens is None:
            return self.lens is other.lens
        return self.lens.is_same(other.lens, _SAME)


def calibration_from(message: Any, image_topic: str, rectified: str) -> Calibration | None:
    """Decode a CameraInfo; None for one that says "not calibrated" (no focal length in K).

    A rectified image is described by P. The pose is then in the rectified optical frame, which R turns from the raw
    one. A raw image is described by K; its distortion is undone, R is not applied, and the pose stays in the camera's
    own optical frame. Binning and a region of interest are applied to the matrix.

    Args:
        message: the CameraInfo.
        image_topic: name of the image's topic.
        rectified: ``true``, ``false``, or ``auto``: by the topic's name.

    Raises:
        FrameError: an impossible matrix, a distortion model that is not supported, a region of interest that does not
            fit, or no way to tell which of the two images it is.
    """
    k, p = _matrix(message, "k", (3, 3)), _matrix(message, "p", (3, 4))[:, :3]
    if not k[:2, :2].any():
        return None
    d = np.asarray(message.d, dtype=np.float64).ravel()
    alike = not p.any() or _close(k, p, _ALIKE)
    raw_camera = _camera_of(message, k, "k")
    if not d.any() and alike:
        return Calibration(raw_camera)
    if _is_rectified(k, p, d, image_topic, rectified):
        return _of_rectified(message, k, p, d)
    if not d.any():
        return Calibration(raw_camera, said="the images are raw and without distortion: camera_info.k is used, not p")
    lens = Lens.of(message.distortion_model, d, raw_camera)
    return Calibration(raw_camera, lens, f"the images are raw: their distortion ({lens.model}) is undone")


def _is_rectified(k: Float, p: Float, d: Float, topic: str, option: str) -> bool:
    """Whether P describes the image."""
    if option != "auto":
        return option == "true"
    if _RECTIFIED_NAME.search(topic):
        return True
    if _RAW_NAME.search(topic) or not p.any() or _close(k, p, _ALIKE):
        return False
    raise FrameError(
        f"camera_info has a matrix for the raw image (k: fx {k[0, 0]:g}, d: {d.tolist()}) and another one for the "
        f"rectified image (p: fx {p[0, 0]:g}), and the topic's name {topic} does not tell which image this is: set "
        f"camera.rectified (--rectified) to true or false"
    )


def _of_rectified(message: Any, k: Float, p: Float, d: Float) -> Calibration:
    """P counts; K where there is no P and no distortion."""
    if not p.any() and d.any():
        raise FrameError(
            f"the image is rectified by its topic's name or by camera.rectified, but camera_info.p is all zero and "
            f"d = {d.tolist()}: give the matrix of the rectified image in p, or set camera.rectified (--rectified) to "
            f"false for a raw image"
        )
    if not p.any():
        return Calibration(_camera_of(message, k, "k"))
    R = _matrix(message, "r", (3, 3))
    turned = (
        ", and poses are in the rectified frame that r states" if R.any() and not _close(R, np.eye(3), _SAME) else ""
    )
    return Calibration(_camera_of(message, p, "p"), said=f"the images are rectified: camera_info.p is used{turned}")


def _matrix(message: Any, name: str, shape: tuple[int, int]) -> Float:
    values = np.asarray(getattr(message, name), dtype=np.float64).reshape(shape)
    if not np.isfinite(values).all():
        raise FrameError(f"camera_info.{name} must be finite, found {values.ravel().tolist()}")
    return values


def _camera_of(message: Any, matrix: Float, name: str) -> Camera:
    """The matrix moved into the region of interest and scaled to binned pixels, whose centres are those of their block.

    Raises:
        FrameError: the matrix is none of a pinhole camera, or the region does not fit.
    """
    width, height, roi = int(message.width), int(message.height), message.roi
    bins = np.array([max(1, int(message.binning_x)), max(1, int(message.binning_y))])
    try:
        whole = Camera(np.array(matrix), width, height)
    except FrameError as error:
        raise FrameError(f"camera_info.{name}: {error}") from None
    offset, size = np.array([int(roi.x_offset), int(roi.y_offset)]), np.array([int(roi.width), int(roi.height)])
    if not offset.any() and not size.any():
        size = np.array([width, height])
    if (size <= 0).any() or (offset + size > [width, height]).any():
        raise FrameError(
            f"camera_info.roi ({size[0]}x{size[1]} px at {offset[0]}, {offset[1]}) does not lie in the image of "
            f"{width}x{height} px: width and height are those of the whole sensor"
        )
    is_whole = not offset.any() and (size == [width, height]).all()
    if is_whole and (bins == 1).all():
        return whole
    if name == "p" and roi.do_rectify and not is_whole:
        raise FrameError(
            "camera_info.roi with do_rectify cuts the rectified image where no field says: rectify the whole image"
        )
    K = whole.K.copy()
    K[:2, 2] = (K[:2, 2] - offset + 0.5) / bins - 0.5
    K[:2, :2] /= bins[:, None]
    return Camera(K, int(size[0] // bins[0]), int(size[1] // bins[1]))


def _close(a: Float, b: Float, tolerance: float) -> bool:
    """Whether two matrices agree, in units of the first entry (the focal length)."""
    return bool(np.abs(a - b).max() <= tolerance * abs(a[0, 0]))
