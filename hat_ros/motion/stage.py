"""Target-relative motion as the tracker and the node see it: background suppressed, then one backend.

Paper, Target-Relative Motion Estimation: the estimator sees the whole frame with the background set to zero, so that it
follows the target and not the Earth; a static scene seen by a moving camera needs no mask (``slam.masked: false``).
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from hat_ros.array_types import Bool, UInt8
from hat_ros.config import HatConfig
from hat_ros.stages import create_backend
from hat_ros.target.model import Target
from hat_ros.types import Detection, Frame, Motion, PosePrior


class MotionStage:
    """Where the camera is relative to the target, up to gauge and scale.

    Args:
        config: the whole configuration; ``slam.backend`` names the backend.
        target: the CAD model.
    """

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._masked = config.slam.masked
        self._backend = create_backend("slam", config, target)
        self._epoch = 0

    def update(self, frame: Frame, detection: Detection | None, prior: PosePrior | None) -> Motion:
        """Advance by one frame.

        Args:
            frame: the admitted frame.
            detection: the mask of Stage 1, or None. While masked, a frame without one does not reach the backend and
                has no motion.
            prior: what fused poses of the past say, or None.

        Returns:
            The motion; not valid rather than guessed.
        """
        if self._masked:
            if detection is None:
                return Motion.none(self._epoch)
            frame = replace(frame, rgb=suppress_background(frame.rgb, detection.mask))
        motion = self._backend.update(frame, detection, prior)
        self._epoch = motion.epoch
        return motion

    def reset(self) -> None:
        """Forget the target; the next motion is in a new epoch."""
        self._backend.reset()


def suppress_background(rgb: UInt8, mask: Bool) -> UInt8:
    """Black outside the mask: (H, W, 3) uint8, (H, W) bool -> (H, W, 3) uint8."""
    # Tens of times faster than a broadcast product.
    return np.asarray(cv2.copyTo(rgb, mask.view(np.uint8), np.zeros_like(rgb)), np.uint8)
