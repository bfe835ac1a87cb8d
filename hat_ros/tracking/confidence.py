"""How certain the output's basin is: what the hypotheses of the last keyframes say of it and of competing basins."""

from __future__ import annotations

from collections import deque

import numpy as np

from hat_ros.array_types import Float
from hat_ros.config import RefinementConfig
from hat_ros.types import Selection, StateReason

# Keyframes in a row whose best appearance must lie in the output's basin: errors of a mask persist, but not so long.
_KEYFRAMES = 2


class BasinConfidence:
    """Compares the output with the decoder and with appearance alone.

    The decoder weighs all keyframes so far, and one clear mistake carries it for a while; the best appearance of a
    keyframe is independent of earlier ones. Where the two differ, the basin is ambiguous.

    Args:
        config: the ``refinement`` section.
        apart_deg: orientations further apart than this are different basins.

    Attributes:
        margin: lead in path score of the output's basin at the last keyframe, NaN before the first.
    """

    def __init__(self, config: RefinementConfig, apart_deg: float) -> None:
        self._config = config
        self._apart_deg = apart_deg
        self.margin = float("nan")
        self._appearance: deque[float] = deque(maxlen=_KEYFRAMES)

    def update(self, selection: Selection, T_cam_target: Float | None) -> None:
        """Take in one frame: its candidates, if it is a keyframe, and its output (4, 4), None if there is none."""
        if T_cam_target is None or selection.selected < 0:
            return
        R = T_cam_target[:3, :3]
        self.margin = selection.margin(R, self._apart_deg)
        self._appearance.append(selection.appearance_margin(R, self._apart_deg))

    def decides(self, selection: Selection, T_cam_target: Float) -> bool:
        """Whether a keyframe's decoder clearly prefers the basin of a pose (4, 4)."""
        return selection.margin(T_cam_target[:3, :3], self._apart_deg) >= self._config.min_margin

    def verdict(self, confirmed: bool) -> StateReason:
        """CONFIRMED if the output's basin is certain, else why not; ``confirmed`` by the image or a second anchor."""
        if self.margin < self._config.min_margin:
            return StateReason.AMBIGUOUS
        if min(self._appearance, default=0.0) < 0.0:
            return StateReason.OUTSHONE
        # Without a competing basin the margin is infinite and means nothing.
        is_certain = confirmed or self._config.sure_margin <= self.margin < np.inf
        return StateReason.CONFIRMED if is_certain else StateReason.UNCONFIRMED
