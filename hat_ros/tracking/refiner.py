"""The seam between Stage 4 and the image: what a refiner of poses must offer."""

from __future__ import annotations

from typing import Protocol

from hat_ros.array_types import Float
from hat_ros.types import Detection, Frame, Refined, RotationPrior


class Refiner(Protocol):
    """Moves a pose to the nearest optimum on one image."""

    def refine(
        self, frame: Frame, detection: Detection | None, T_cam_target: Float, prior: RotationPrior | None = None
    ) -> Refined | None:
        """Refine a (4, 4) pose; None when the image has nothing to say near it, or would pull it out of its basin.

        What is known of its rotation counts as much as it is certain. The covariance is the image's alone.
        """
        ...

    def reset(self) -> None:
        """Forget everything learned from earlier frames."""
        ...
