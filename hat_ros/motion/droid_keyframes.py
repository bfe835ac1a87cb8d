"""State of the keyframes of DROID-SLAM: one slot per keyframe in preallocated tensors, oldest first.

The slot behind the last keyframe is the guess for the next one: its pose and inverse depths are where optimisation
will start from.
"""

from __future__ import annotations

from typing import Protocol, Self

import torch
from torch import Tensor

from hat_ros.nets.droid_geometry import compose, invert, log, retract

_FIRST_ETA = 1e-6


class PairCorrelation(Protocol):
    """Correlation of E image pairs, see :class:`hat_ros.nets.droid.Correlation`."""

    def lookup(self, coords: Tensor) -> Tensor:
        """(E, h, w, 2) -> (E, channels, h, w)."""
        ...

    def select(self, index: Tensor) -> None:
        """Keep these edges, in this order."""
        ...

    def append(self, other: Self) -> None:
        """Add edges."""
        ...


class FlowModel(Protocol):
    """What the front end asks of a network; :class:`hat_ros.nets.droid.DroidNet` is the real one."""

    @property
    def dtype(self) -> torch.dtype:
        """Precision of stored features."""
        ...

    def features(self, images_bgr: Tensor) -> Tensor:
        """Matching features (n, C, h, w) of uint8 images (n, 3, H, W)."""
        ...

    def context(self, images_bgr: Tensor) -> tuple[Tensor, Tensor]:
        """First hidden state and context features, each (n, C, h, w)."""
        ...

    def correlation(self, features_i: Tensor, features_j: Tensor, stored: bool) -> PairCorrelation:
        """Correlation of image pairs."""
        ...

    def refine(
        self, hidden: Tensor, inp: Tensor, lookup: Tensor, motion: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Next hidden state, flow correction (E, h, w, 2) and its confidence (E, h, w, 2)."""
        ...

    def damping(self, hidden: Tensor, group: Tensor, n_groups: int) -> Tensor:
        """Damping of inverse depth of each source frame (n_groups, h, w)."""
        ...


class Keyframes:
    """Poses, inverse depths and features of up to ``capacity`` keyframes.

    Args:
        capacity: slots, one of which is kept free for the frame in hand.
        intrinsics: (4,) ``fx fy cx cy`` in units of 8 pixels; its device is used for everything.
        shape: (h, w) at 1/8 resolution.
        dtype: precision of features and hidden states.

    Attributes:
        stamps_ns: stamp of each keyframe.
        retired: keyframes dropped at the old end so far.
        poses: (capacity, 7) ``T_cam_world``.
        disparities: (capacity, h, w) inverse depths.
        eta: (capacity, h, w) latest damping of the inverse depths.
        features, hidden, inp: (capacity, C, h, w), made when the first frame tells C.
    """

    def __init__(self, capacity: int, intrinsics: Tensor, shape: tuple[int, int], dtype: torch.dtype) -> None:
        device = intrinsics.device
        self.capacity, self.shape, self.dtype = capacity, shape, dtype
        self.intrinsics = intrinsics
        self.stamps_ns: list[int] = []
        self.retired = 0
        identity = torch.tensor([0.0, 0, 0, 0, 0, 0, 1], device=device)
        self.poses = identity.repeat(capacity, 1)
        self.disparities = torch.ones(capacity, *shape, device=device)
        self.eta = torch.full((capacity, *shape), _FIRST_ETA, device=device)
        self.features = torch.zeros(0)
        self.hidden = torch.zeros(0)
        self.inp = torch.zeros(0)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def put_features(self, slot: int, features: Tensor) -> None:
        """Store matching features (1, C, h, w) in a slot without making it a keyframe."""
        if not len(self.features):
            self.features = self._slots(features)
        self.features[slot] = features[0].to(self.dtype)

    def append(self, stamp_ns: int, features: Tensor, hidden: Tensor, inp: Tensor) -> None:
        """Make a keyframe of features (1, C, h, w) and context; its pose and depths are the guess in its slot."""
        slot = len(self)
        self.put_features(slot, features)
        if not len(self.hidden):
            self.hidden, self.inp = self._slots(hidden), self._slots(inp)
        self.hidden[slot], self.inp[slot] = hidden[0].to(self.dtype), inp[0].to(self.dtype)
        self.eta[slot] = _FIRST_ETA
        self.stamps_ns.append(stamp_ns)

    def remove(self, index: int) -> None:
        """Take one keyframe out; later ones move down by one, the guess behind the last included."""
        end = min(len(self) + 1, self.capacity)
        for tensor in self._tensors():
            tensor[index : end - 1] = tensor[index + 1 : end].clone()
        del self.stamps_ns[index]

    def retire(self, count: int) -> None:
        """Forget the oldest keyframes for good."""
        end = min(len(self) + 1, self.capacity)
        for tensor in self._tensors():
            tensor[: end - count] = tensor[count:end].clone()
        del self.stamps_ns[:count]
        self.retired += count

    def grow(self) -> None:
        """Double the capacity."""
        self.poses = torch.cat([self.poses, self.poses[:1].expand_as(self.poses)])
        for name in ("disparities", "eta", "features", "hidden", "inp"):
            tensor = getattr(self, name)
            setattr(self, name, torch.cat([tensor, torch.zeros_like(tensor)]))
        self.capacity *= 2

    def predict_next(self, motion_damping: float) -> None:
        """Fill the slot behind the last keyframe: damped constant velocity, and one inverse depth for all pixels."""
        n = len(self)
        velocity = log(compose(self.poses[n - 1], invert(self.poses[n - 2])))
        self.poses[n] = retract(self.poses[n - 1], motion_damping * velocity)
        self.disparities[n] = self.disparities[n - 3 : n - 1].quantile(0.5)

    def interpolated(self, before: int | Tensor, after: int | Tensor, fraction: float | Tensor) -> Tensor:
        """Poses on the constant-velocity line through two keyframes (or (m,) of them each).

        Args:
            before: keyframe at fraction 0.
            after: keyframe at fraction 1.
            fraction: where on the line, shape (m, 1) for several; outside 0 to 1 it extrapolates.

        Returns:
            (7,) or (m, 7).
        """
        start = self.poses[before]
        velocity = log(compose(self.poses[after], invert(start)))
        return retract(start, fraction * velocity)

    def _slots(self, like: Tensor) -> Tensor:
        return torch.zeros(self.capacity, *like.shape[1:], dtype=self.dtype, device=like.device)

    def _tensors(self) -> list[Tensor]:
        every = (self.poses, self.disparities, self.eta, self.features, self.hidden, self.inp)
        return [tensor for tensor in every if len(tensor)]
