"""Stage 1 as the tracker and the node see it: one backend, its masks checked before they are used."""

from __future__ import annotations

import cv2
import numpy as np

from hat_ros.array_types import Bool, UInt8
from hat_ros.config import HatConfig
from hat_ros.core.initial_pose import Acquisition, InitialPose
from hat_ros.errors import FrameError
from hat_ros.stages import create_backend
from hat_ros.target.model import Target
from hat_ros.types import Detection, Frame, PosePrior

# Columns and rows x0, y0, x1, y1 of a part of an image, the last two exclusive.
Window = tuple[int, int, int, int]

# A frame whose brightest pixel is this dark (8-bit) shows nothing: lens cap, eclipse, lost exposure.
_BLACK_LEVEL = 8
# A silhouette that covers more than this share of the image has no outline left to match.
_MAX_COVERAGE = 0.98


class SegmentationStage:
    """Finds the target in each frame; no mask rather than a wrong one.

    Args:
        config: the whole configuration; ``segmentation.backend`` names the backend.
        target: the CAD model.
    """

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._min_area_px = config.segmentation.min_area_px
        self._backend = create_backend("segmentation", config, target)
        self._acquisition = Acquisition(config)
        self._reach_m = float(np.linalg.norm(target.vertices_m, axis=1).max())
        self._window: Window | None = None  # part of the image that the backend was shown last, None = all of it

    def update(self, frame: Frame, prior: PosePrior | None, given: InitialPose | None = None) -> Detection | None:
        """Segment one frame.

        Args:
            frame: the admitted frame.
            prior: prediction from fused poses of the past, or None.
            given: what navigation says of the target, in force from this frame on.

        Returns:
            The detection, or None when the frame is black or the mask is too small or covers the whole image, or is not
            where an initial pose says that the target must be.

        Raises:
            FrameError: the backend's mask does not have the image's size.
        """
        initial = self._acquisition.at(prior, given)
        if is_black(frame.rgb):
            return None
        region = None if initial is None else initial.region(frame.camera, self._reach_m)
        if region is not None and region.is_empty:
            return None
        self._look_through(None if region is None else region.window_xyxy, frame)
        if self._window is None:
            detection = self._checked(frame, self._backend.update(frame, prior))
        else:
            part = _part(frame, self._window)
            detection = self._checked(part, self._backend.update(part, prior))
            detection = None if detection is None else _in_whole_image(detection, self._window, frame)
        if detection is None or detection.area_px < self._min_area_px:
            return None
        if region is not None and np.ptp(detection.box_xyxy.reshape(2, 2), axis=0).max() > region.largest_px:
            return None
        self._acquisition.found()
        return detection

    def reset(self) -> None:
        """Forget everything learned from earlier frames."""
        self._backend.reset()
        self._acquisition.reset()

    def _look_through(self, window: Window | None, frame: Frame) -> None:
        """Show the backend this part of the image from now on; what it remembers is of the part before."""
        if window == (0, 0, frame.camera.width, frame.camera.height):
            window = None
        if window != self._window:
            self._backend.reset()
            self._window = window

    def _checked(self, frame: Frame, detection: Detection | None) -> Detection | None:
        """A detection that can be used."""
        if detection is None:
            return None
        mask = detection.mask
        if mask.dtype != np.bool_ or mask.shape != frame.rgb.shape[:2]:
            raise FrameError(
                f"frame {frame.stamp_ns}: the segmentation mask must be bool {frame.rgb.shape[:2]}, "
                f"found {mask.dtype} {mask.shape}"
            )
        if detection.area_px < self._min_area_px:
            return None
        if detection.silhouette and detection.area_px > _MAX_COVERAGE * mask.size:
            return None
        return detection


def _part(frame: Frame, window: Window) -> Frame:
    """A part of a frame as a frame of its own."""
    x0, y0, x1, y1 = window
    rows, cols = slice(y0, y1), slice(x0, x1)
    mask = None if frame.given_mask is None else np.ascontiguousarray(frame.given_mask[rows, cols])
    camera = frame.camera.crop(x0, y0, x1 - x0, y1 - y0)
    return Frame(frame.stamp_ns, np.ascontiguousarray(frame.rgb[rows, cols]), camera, mask)


def _in_whole_image(detection: Detection, window: Window, frame: Frame) -> Detection | None:
    """A detection in a part of an image, without what goes on beyond that: the target ends inside. None: all does."""
    x0, y0, x1, y1 = window
    part = detection.mask
    if detection.silhouette:
        inner = np.zeros_like(part)  # the borders of the part that are none of the image
        inner[0], inner[-1] = y0 > 0, y1 < frame.camera.height
        inner[:, 0] |= x0 > 0
        inner[:, -1] |= x1 < frame.camera.width
        part = _without_pieces(part, inner)
        if not part.any():
            return None
    mask = np.zeros(frame.rgb.shape[:2], np.bool_)
    mask[y0:y1, x0:x1] = part
    return Detection(mask, detection.silhouette)


def _without_pieces(mask: Bool, touched: Bool) -> Bool:
    """A mask without its connected pieces that have a pixel among those touched."""
    if not (mask & touched).any():
        return mask
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    keep = np.ones(count, np.bool_)
    keep[labels[mask & touched]] = False
    kept: Bool = mask & keep[labels]
    return kept


def is_black(rgb: UInt8) -> bool:
    """Whether an (H, W, 3) uint8 image shows nothing at all (or has no contrast because it is all white)."""
    low, high, _, _ = cv2.minMaxLoc(rgb.reshape(rgb.shape[0], -1))
    return high < _BLACK_LEVEL or low == high
