"""The factor graph of DROID-SLAM: which frames are compared, and one recurrent update over all of them.

Edges live on the host as small integer arrays, so that every decision about them costs no transfer; what belongs to
an edge (hidden state, correlation, wanted coordinates, confidence) lives on the device in the same order.
(arXiv:2108.10869, sections 3.3 and 3.4.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hat_ros.array_types import Bool, Float32, Int
from hat_ros.motion.droid_keyframes import FlowModel, Keyframes, PairCorrelation
from hat_ros.nets.droid_ba import (
    LOCAL_DAMPING,
    PUBLISHED_RULE,
    BundleLayout,
    BundleRule,
    Damping,
    bundle_adjust,
)
from hat_ros.nets.droid_geometry import frame_distance, pixel_grid, reproject
from hat_ros.spans import span

Index = Int
Pairs = Int

MAX_FACTORS = 48
# Frames further apart than this (units of 8 pixels) are never compared.
_MAX_DISTANCE = 100.0
# Retired edges take part in bundle adjustment while both ends are at most this far before the first free pose.
INACTIVE_MARGIN = 3


@dataclass(frozen=True)
class ProximityRule:
    """Which frames count as close.

    Attributes:
        radius: neighbours in time up to ``radius + 1`` are always connected.
        nms: an edge keeps others away from its surroundings up to this L1 distance in (i, j).
        threshold: largest frame distance, in units of 8 pixels.
        beta: share of the full motion in the frame distance.
    """

    radius: int
    nms: int
    threshold: float
    beta: float


def neighbour_pairs(first: int, end: int, radius: int) -> Pairs:
    """All ordered pairs of different frames in [first, end) at most ``radius`` apart: -> (E, 2)."""
    frames = np.arange(first, end)
    i, j = (axis.ravel() for axis in np.meshgrid(frames, frames, indexing="ij"))
    close = (np.abs(i - j) > 0) & (np.abs(i - j) <= radius)
    return np.stack([i[close], j[close]], axis=1)


def ascending(values: Float32 | Index) -> Index:
    """Order of the values (n,), equal ones as the released tracker has them: by torch's sort, which is not stable."""
    return torch.argsort(torch.from_numpy(np.ascontiguousarray(values))).numpy()


def proximity_pairs(
    distance: Float32,
    first_i: int,
    first_j: int,
    existing: Pairs,
    rule: ProximityRule,
    max_factors: int,
) -> Pairs:
    """Choose edges by frame distance, temporal neighbours first, then ascending, thinned around what exists.

    Args:
        distance: (n_i, n_j) distance of frames ``first_i + row`` and ``first_j + column``.
        first_i: frame of the first row.
        first_j: frame of the first column.
        existing: (E, 2) edges that suppress their surroundings.
        rule: what counts as close.
        max_factors: stop when the list is longer than this.

    Returns:
        (n, 2) edges, both directions of each.
    """
    n_i, n_j = distance.shape
    i, j = first_i + np.arange(n_i)[:, None], first_j + np.arange(n_j)[None, :]
    d = np.where((i - rule.radius < j) | (distance > _MAX_DISTANCE), np.inf, distance)

    def suppress(a: int, b: int) -> None:
        reach = max(min(abs(a - b) - 2, rule.nms), 0)
        d[np.abs(i - a) + np.abs(j - b) <= reach] = np.inf

    for a, b in existing:
        suppress(int(a), int(b))
    chosen: list[tuple[int, int]] = []
    for a in range(first_i, first_i + n_i):
        for b in range(max(a - rule.radius - 1, 0), a):
            chosen += [(a, b), (b, a)]
            if b >= first_j:
                d[a - first_i, b - first_j] = np.inf
    for flat in ascending(d.ravel()):
        row, column = divmod(int(flat), n_j)
        if d[row, column] > rule.threshold:
            # Candidates come in ascending order, but one may have been suppressed since it was sorted.
            continue
        if len(chosen) > max_factors:
            break
        a, b = first_i + row, first_j + column
        chosen += [(a, b), (b, a)]
        suppress(a, b)
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)


class FactorGraph:
    """Edges between keyframes and the recurrent state on them.

    Args:
        model: the flow network.
        keyframes: the frames that edges refer to; poses and depths are updated in it.
        max_factors: limit of active edges where room is made for new ones.
        stored: keep the correlation volumes instead of forming them at every update.
        rule: variant of the bundle adjustment.
        inactive_margin: how many frames before the first free pose retired edges may reach.

    Attributes:
        n_fixed: poses that never move, at the old end.
    """

    def __init__(
        self,
        model: FlowModel,
        keyframes: Keyframes,
        *,
        max_factors: int = MAX_FACTORS,
        stored: bool = True,
        rule: BundleRule = PUBLISHED_RULE,
        inactive_margin: int = INACTIVE_MARGIN,
    ) -> None:
        self.inactive_margin, self.n_fixed = inactive_margin, 1
        self.model, self.keyframes = model, keyframes
        self.max_factors, self.stored, self.rule = max_factors, stored, rule
        h, w = keyframes.shape
        self._device = keyframes.intrinsics.device
        self._grid = pixel_grid(h, w, self._device)
        none = np.zeros(0, dtype=np.int64)
        self.ii, self.jj, self.age = none, none, none
        self.ii_inactive, self.jj_inactive = none, none
        self.hidden = torch.zeros(0, device=self._device)
        self.correlation: PairCorrelation | None = None
        self.target = torch.zeros(0, h, w, 2, device=self._device)
        self.weight, self.target_inactive, self.weight_inactive = self.target, self.target, self.target
        self._plan: _UpdatePlan | None = None

    def __len__(self) -> int:
        return len(self.ii)

    def add(self, pairs: Pairs, make_room: bool = False) -> None:
        """Add edges that are neither active nor retired yet; ``make_room`` retires old ones beyond the limit."""
        known = set(zip(self.ii, self.jj, strict=True)) | set(zip(self.ii_inactive, self.jj_inactive, strict=True))
        pairs = np.array([pair for pair in pairs if tuple(pair) not in known], dtype=np.int64).reshape(-1, 2)
        if not len(pairs):
            return
        if make_room and len(self) + len(pairs) > self.max_factors:
            # The released tracker compares the values of the sorting permutation, not ranks, with the limit.
            order = ascending(self.age)
            self.drop(order >= self.max_factors - len(pairs), retire=True)
        self._plan = None
        frames, new_i, new_j = self.keyframes, *(self._send(pairs[:, side]) for side in (0, 1))
        target, _ = reproject(frames.poses, frames.disparities, frames.intrinsics, new_i, new_j)
        hidden = frames.hidden[new_i]
        correlation = self.model.correlation(frames.features[new_i], frames.features[new_j], self.stored)
        if self.correlation is None or not len(self):
            self.hidden, self.correlation = hidden, correlation
        else:
            self.hidden = torch.cat([self.hidden, hidden])
            self.correlation.append(correlation)
        self.target = torch.cat([self.target, target])
        self.weight = torch.cat([self.weight, torch.zeros_like(target)])
        self.ii, self.jj = np.concatenate([self.ii, pairs[:, 0]]), np.concatenate([self.jj, pairs[:, 1]])
        self.age = np.concatenate([self.age, np.zeros(len(pairs), dtype=np.int64)])

    def add_by_proximity(self, first_i: int, first_j: int, rule: ProximityRule, make_room: bool = False) -> None:
        """Add edges between close frames; sources from ``first_i``, targets from ``first_j`` on."""
        n = len(self.keyframes)
        i, j = np.meshgrid(np.arange(first_i, n), np.arange(first_j, n), indexing="ij")
        distance = self.distance(i.ravel(), j.ravel(), rule.beta).reshape(i.shape)
        existing = np.stack(
            [np.concatenate([self.ii, self.ii_inactive]), np.concatenate([self.jj, self.jj_inactive])], axis=1
        )
        self.add(proximity_pairs(distance, first_i, first_j, existing, rule, self.max_factors), make_room)

    def distance(self, i: Index, j: Index, beta: float) -> Float32:
        """Frame distance of pairs on the host: (n,), (n,) -> (n,). Waits for the device."""
        frames = self.keyframes
        d = frame_distance(frames.poses, frames.disparities, frames.intrinsics, self._send(i), self._send(j), beta)
        return d.cpu().numpy()

    def drop(self, mask: Bool, retire: bool) -> None:
        """Take active edges out; retired ones keep their last coordinates for bundle adjustment."""
        if not mask.any():
            return
        self._plan = None
        if retire:
            gone = self._send(np.flatnonzero(mask))
            self.ii_inactive = np.concatenate([self.ii_inactive, self.ii[mask]])
            self.jj_inactive = np.concatenate([self.jj_inactive, self.jj[mask]])
            self.target_inactive = torch.cat([self.target_inactive, self.target[gone]])
            self.weight_inactive = torch.cat([self.weight_inactive, self.weight[gone]])
        self.ii, self.jj, self.age = self.ii[~mask], self.jj[~mask], self.age[~mask]
        kept = self._send(np.flatnonzero(~mask))
        self.hidden, self.target, self.weight = self.hidden[kept], self.target[kept], self.weight[kept]
        if self.correlation is not None:
            self.correlation.select(kept)

    def borrow(self, other: FactorGraph, first_source: int) -> None:
        """Take the edges of another graph that start at ``first_source`` or later as retired ones of this graph."""
        self._plan = None
        active, retired = other.ii >= first_source, other.ii_inactive >= first_source
        picked, picked_inactive = self._send(np.flatnonzero(active)), self._send(np.flatnonzero(retired))
        self.ii_inactive = np.concatenate([other.ii[active], other.ii_inactive[retired]])
        self.jj_inactive = np.concatenate([other.jj[active], other.jj_inactive[retired]])
        self.target_inactive = torch.cat([other.target[picked], other.target_inactive[picked_inactive]])
        self.weight_inactive = torch.cat([other.weight[picked], other.weight_inactive[picked_inactive]])

    def remove_keyframe(self, index: int) -> None:
        """Forget a keyframe and all its edges; later keyframes move down by one."""
        self._drop_inactive((self.ii_inactive == index) | (self.jj_inactive == index))
        self.drop((self.ii == index) | (self.jj == index), retire=False)
        self._renumber(lambda frames: frames - (frames >= index))
        self.keyframes.remove(index)

    def retire_keyframes(self, count: int) -> None:
        """Forget the oldest keyframes; none of them may have an active edge."""
        self._drop_inactive((self.ii_inactive < count) | (self.jj_inactive < count))
        self._renumber(lambda frames: frames - count)
        self.n_fixed = max(self.n_fixed - count, 1)
        self.keyframes.retire(count)

    def oldest_needed(self) -> int:
        """Oldest keyframe that an active edge, or bundle adjustment over them, may still touch."""
        if not len(self):
            return len(self.keyframes)
        first_free = max(self.n_fixed, int(self.ii.min()) + 1)
        return max(min(int(self.ii.min()), int(self.jj.min()), first_free - self.inactive_margin), 0)

    def update(
        self,
        first: int | None = None,
        *,
        use_inactive: bool = False,
        motion_only: bool = False,
        damping: Damping = LOCAL_DAMPING,
    ) -> None:
        """One step of the network on every active edge, then bundle adjustment.

        Args:
            first: first free pose; default is the one behind the oldest source frame.
            use_inactive: let retired edges of the same frames take part in bundle adjustment.
            motion_only: keep the depths.
            damping: of the bundle adjustment.
        """
        frames, plan = self.keyframes, self._planned(first, use_inactive)
        coords, _ = reproject(frames.poses, frames.disparities, frames.intrinsics, plan.ii, plan.jj)
        motion = torch.cat([coords - self._grid, self.target - coords], dim=-1).permute(0, 3, 1, 2)
        assert self.correlation is not None, "an update needs edges"
        lookup = self.correlation.lookup(coords)
        self.hidden, delta, self.weight = self.model.refine(self.hidden, frames.inp[plan.ii], lookup, motion)
        self.target = coords + delta
        eta = None
        if not motion_only:
            frames.eta.index_copy_(0, plan.sources, self.model.damping(self.hidden, plan.group, len(plan.sources)))
            eta = frames.eta[plan.layout.frames]
        with span("bundle adjustment"):
            frames.poses, frames.disparities = bundle_adjust(
                frames.poses,
                frames.disparities,
                frames.intrinsics,
                torch.cat([plan.target_inactive, self.target]),
                torch.cat([plan.weight_inactive, self.weight]),
                plan.layout,
                eta=eta,
                damping=damping,
                rule=self.rule,
                motion_only=motion_only,
            )
        self.age = self.age + 1

    def _planned(self, first: int | None, use_inactive: bool) -> _UpdatePlan:
        """Index tensors of an update, made once per change of the graph."""
        if first is None:
            first = max(self.n_fixed, int(self.ii.min()) + 1)
        if self._plan is not None and (self._plan.first, self._plan.use_inactive) == (first, use_inactive):
            return self._plan
        oldest = first - self.inactive_margin
        extra = (self.ii_inactive >= oldest) & (self.jj_inactive >= oldest)
        extra &= use_inactive
        ii = np.concatenate([self.ii_inactive[extra], self.ii])
        jj = np.concatenate([self.jj_inactive[extra], self.jj])
        sources, group = np.unique(self.ii, return_inverse=True)
        picked = self._send(np.flatnonzero(extra))
        self._plan = _UpdatePlan(
            first=first,
            use_inactive=use_inactive,
            ii=self._send(self.ii),
            jj=self._send(self.jj),
            sources=self._send(sources),
            group=self._send(group),
            target_inactive=self.target_inactive[picked],
            weight_inactive=self.weight_inactive[picked],
            layout=BundleLayout(ii, jj, first, int(max(ii.max(), jj.max())) + 1, self._device),
        )
        return self._plan

    def _drop_inactive(self, mask: Bool) -> None:
        self._plan = None
        kept = self._send(np.flatnonzero(~mask))
        self.ii_inactive, self.jj_inactive = self.ii_inactive[~mask], self.jj_inactive[~mask]
        self.target_inactive, self.weight_inactive = self.target_inactive[kept], self.weight_inactive[kept]

    def _renumber(self, new_index: Callable[[Index], Index]) -> None:
        self._plan = None
        self.ii, self.jj = new_index(self.ii), new_index(self.jj)
        self.ii_inactive, self.jj_inactive = new_index(self.ii_inactive), new_index(self.jj_inactive)

    def _send(self, array: Index) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._device, non_blocking=True)


@dataclass(frozen=True)
class _UpdatePlan:
    """What an update needs to know of the edges, on the device."""

    first: int
    use_inactive: bool
    ii: Tensor
    jj: Tensor
    sources: Tensor
    group: Tensor
    target_inactive: Tensor
    weight_inactive: Tensor
    layout: BundleLayout
