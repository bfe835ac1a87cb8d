"""Lens distortion as ``camera_info`` states it, and the images without it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from hat_ros.array_types import Float, Float32, UInt8
from hat_ros.errors import FrameError
from hat_ros.types import Camera

PLUMB_BOB, EQUIDISTANT = "plumb_bob", "equidistant"
# Name in camera_info -> (which of OpenCV's two models, the most coefficients that it has).
MODELS: dict[str, tuple[str, int]] = {
    "plumb_bob": (PLUMB_BOB, 14),
    "rational_polynomial": (PLUMB_BOB, 14),
    "radtan": (PLUMB_BOB, 5),
    "brown_conrady": (PLUMB_BOB, 5),
    "equidistant": (EQUIDISTANT, 4),
    "fisheye": (EQUIDISTANT, 4),
    "kannala_brandt4": (EQUIDISTANT, 4),
}
_OPENCV_COUNTS = (4, 5, 8, 12, 14)
_PROFILE_STEPS = 1024
_LEAST_SEEN = 0.5


@dataclass(frozen=True, eq=False)
class Lens:
    """A distortion that OpenCV can undo.

    The image without it has the same size and the same camera matrix. So a pixel's ray, and with it the pose, stays in
    the optical frame that the image names, and the scale in the middle of the image is kept. What leaves the image is
    cut off; pixels that no ray of the lens reaches are black.

    Attributes:
        model: ``plumb_bob`` (also ``rational_polynomial``: k1 k2 p1 p2 k3 k4 k5 k6 and on) or ``equidistant``
            (fisheye: k1 k2 k3 k4).
        coefficients: as many as OpenCV's function takes.
        camera: the image's camera, which stays.
    """

    model: str
    coefficients: Float
    camera: Camera

    @classmethod
    def of(cls, name: str, d: Float, camera: Camera) -> Lens:
        """The lens of a camera_info.

        Args:
            name: ``distortion_model``.
            d: the coefficients, not all zero.
            camera: camera of the image as it is.

        Raises:
            FrameError: another model, or coefficients that do not fit it.
        """
        if not np.isfinite(d).all():
            raise FrameError(f"camera_info.d must be finite, found {d.tolist()}")
        if not name and len(d) >= 5:
            name = PLUMB_BOB
        if name not in MODELS:
            raise FrameError(
                f"camera_info.distortion_model '{name}' is not supported with d = {d.tolist()}, use one of "
                f"{', '.join(MODELS)}, or rectify the image and set camera.rectified (--rectified) to true"
            )
        model, most = MODELS[name]
        used = np.trim_zeros(d, "b")
        if len(used) > most:
            raise FrameError(f"camera_info.d may have {most} coefficients ({name}), found {len(d)}: {d.tolist()}")
        count = most if model == EQUIDISTANT else next(n for n in _OPENCV_COUNTS if n >= len(used))
        return cls(model, np.pad(used, (0, count - len(used))), camera)

    def is_same(self, other: Lens, tolerance: float) -> bool:
        """Whether model and coefficients agree."""
        if self.model != other.model or len(self.coefficients) != len(other.coefficients):
            return False
        return np.allclose(self.coefficients, other.coefficients, rtol=tolerance, atol=tolerance)

    def undistort(self, image: UInt8) -> UInt8:
        """The (H, W, 3) image without distortion; linear interpolation, black where there is no data."""
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR).astype(np.uint8, copy=False)

    def undistort_mask(self, mask: UInt8) -> UInt8:
        """The (H, W) mask without distortion, its values kept; 0 where there is no data."""
        return cv2.remap(mask, *self._maps, cv2.INTER_NEAREST).astype(np.uint8, copy=False)

    @cached_property
    def _maps(self) -> tuple[Float32, Float32]:
        """Where each pixel comes from; -1 beyond the radius at which the polynomial turns back.

        Raises:
            FrameError: less than half of the image has data.
        """
        K, size = self.camera.K, (self.camera.width, self.camera.height)
        if self.model == EQUIDISTANT:
            x, y = cv2.fisheye.initUndistortRectifyMap(K, self.coefficients, np.eye(3), K, size, cv2.CV_32FC1)
        else:
            x, y = cv2.initUndistortRectifyMap(K, self.coefficients, None, K, size, cv2.CV_32FC1)
        map_x, map_y = np.asarray(x, np.float32), np.asarray(y, np.float32)
        radii, (width, height) = self._radii(), size
        beyond = radii > self._largest_radius(float(radii.max()))
        seen = (map_x >= 0) & (map_x <= width - 1) & (map_y >= 0) & (map_y <= height - 1) & ~beyond
        if seen.mean() < _LEAST_SEEN:
            raise FrameError(
                f"camera_info.d = {self.coefficients.tolist()} is no lens of this image: more than half of the image "
                f"without distortion has no data; calibrate the camera again"
            )
        map_x[beyond] = map_y[beyond] = -1.0
        return map_x, map_y

    def _radii(self) -> Float:
        """(H, W) distance from the optical axis in the image without distortion, at depth one."""
        K = self.camera.K
        y = (np.arange(self.camera.height)[:, None] - K[1, 2]) / K[1, 1]
        x = (np.arange(self.camera.width)[None, :] - K[0, 2] - K[0, 1] * y) / K[0, 0]
        return np.hypot(x, y)

    def _largest_radius(self, most: float) -> float:
        """Up to where the distorted radius grows with the true one: a polynomial beyond its data may turn back."""
        radii = np.linspace(0.0, 1.01 * most, _PROFILE_STEPS)
        with np.errstate(all="ignore"):  # a polynomial that overflows turns there
            grows = np.diff(self._distorted(radii)) > 0.0
        turns = np.flatnonzero(~grows)
        return float(radii[turns[0]]) if len(turns) else float("inf")

    def _distorted(self, radii: Float) -> Float:
        """Distorted radius of each radius, tangential terms left out."""
        if self.model == EQUIDISTANT:
            angle = np.arctan(radii)
            return angle * (1.0 + np.polynomial.polynomial.polyval(angle**2, np.r_[0.0, self.coefficients]))
        k = np.pad(self.coefficients, (0, 14 - len(self.coefficients)))
        squared = radii**2
        above = np.polynomial.polynomial.polyval(squared, [1.0, k[0], k[1], k[4]])
        below = np.polynomial.polynomial.polyval(squared, [1.0, k[5], k[6], k[7]])
        return radii * above / below
