"""The inertial prior of Stage 4: the target goes on moving and turning as it did.

The paper (Sec. "Continuous-State Filters and Dynamics Priors") penalises "translational second differences and changes
in world-frame incremental rotation", beside the relative residual. Here each relative motion is drawn towards the one
before it: v weighs the change between the two increments as w weighs the discrepancy with SLAM, rotation and
translation each for themselves, and the minimum, in closed form, is the prediction that eq. (causalfusion) then meets
the anchor with.

The increments are those of the predicted motion, without the corrections that anchors bring. Second differences of the
outputs themselves would take every correction for a velocity: with past outputs fixed, half of it would be added again
in the next frame, and a quarter in the one after (tried: the error doubles at v = w / 10 and grows tenfold at w / 3).
"""

from __future__ import annotations

from hat_ros.array_types import Float
from hat_ros.geometry import lie


class InertialPrior:
    """Smooths the relative motion of successive frames; frames count, not seconds, as in the paper.

    The increments are those of an observer whose axes do not turn: the camera's.

    Args:
        inertial_weight: v, in the unit of w.
        relative_weight: w; at zero there is no motion to smooth.
    """

    def __init__(self, inertial_weight: float, relative_weight: float) -> None:
        total = inertial_weight**2 + relative_weight**2
        self._share = inertial_weight**2 / total if relative_weight > 0.0 else 0.0
        self._last: tuple[Float, Float] | None = None

    def forget(self) -> None:
        """A frame has no prediction: the increments before it are void."""
        self._last = None

    def smooth(self, output: Float, predicted: Float) -> Float:
        """The prediction drawn towards the last increment: (4, 4).

        Args:
            output: (4, 4) previous output.
            predicted: (4, 4) relative motion applied to it.
        """
        if self._share == 0.0:
            return predicted
        R, t = predicted[:3, :3], predicted[:3, 3]
        if self._last is not None:
            turn, shift = self._last
            R = lie.so3_exp(self._share * lie.so3_log(turn @ output[:3, :3] @ R.T)) @ R
            t = (1.0 - self._share) * t + self._share * (output[:3, 3] + shift)
        self._last = R @ output[:3, :3].T, t - output[:3, 3]
        return lie.transform(R, t)
