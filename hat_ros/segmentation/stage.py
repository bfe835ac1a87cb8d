"""Stage 1 as the tracker and the node see it: one backend, its masks checked before they are used."""

from __future__ import annotations

import cv2
import numpy as np

from hat_ros.array_types import UInt8
from hat_ros.config import HatConfig
from hat_ros.errors import FrameError
from hat_ros.stages import create_backend
from hat_ros.target.model import Target
from hat_ros.types import Detection, Frame, PosePrior

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

    def update(self, frame: Frame, prior: PosePrior | None) -> Detection | None:
        """Segment one frame.

        Args:
            frame: the admitted frame.
            prior: prediction from fused poses of the past, or None.

        Returns:
            The detection, or None when the frame is black or the mask is too small or covers the whole image.

        Raises:
            FrameError: the backend's mask does not have the image's size.
        """
        if is_black(frame.rgb):
            return None
        detection = self._backend.update(frame, prior)
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

    def reset(self) -> None:
        """Forget everything learned from earlier frames."""
        self._backend.reset()


def is_black(rgb: UInt8) -> bool:
    """Whether an (H, W, 3) uint8 image shows nothing at all (or has no contrast because it is all white)."""
    low, high, _, _ = cv2.minMaxLoc(rgb.reshape(rgb.shape[0], -1))
    return high < _BLACK_LEVEL or low == high
