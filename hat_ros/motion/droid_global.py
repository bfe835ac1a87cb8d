"""Smoothing over the whole clip: two global bundle adjustments over all keyframes, then a pose for every frame.

Not causal and not used by the tracker: it says how much the causal read-out gives away. (arXiv:2108.10869, section
3.4, back end; poses of the other frames as in the released tracker.)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice

import numpy as np
import torch
from torch import Tensor

from hat_ros.errors import RunError
from hat_ros.motion.droid_frontend import DroidFrontend
from hat_ros.motion.droid_graph import FactorGraph, Pairs, ProximityRule, proximity_pairs
from hat_ros.nets.droid_ba import GLOBAL_DAMPING, BundleLayout, bundle_adjust
from hat_ros.nets.droid_geometry import frame_distance, pixel_grid, reproject

GLOBAL_STEPS = (7, 12)
_SOURCES_AT_ONCE = 8
_EDGES_PER_KEYFRAME = 16
_FRAMES_AT_ONCE = 16
_FILL_UPDATES = 6


def finish(frontend: DroidFrontend, images: Iterable[tuple[int, Tensor]]) -> Tensor:
    """Optimise a finished run globally and give every frame its pose.

    Args:
        frontend: a front end made with ``keep_all`` that has tracked the whole clip; its keyframes are updated.
        images: stamp and image (1, 3, H, W) uint8 BGR of every frame, in order.

    Returns:
        (n, 7) ``T_cam_world``.

    Raises:
        RunError: the clip never left the warm-up.
    """
    if not frontend.initialised:
        raise RunError(
            f"DROID over a whole clip: it has {len(frontend.keyframes)} keyframes, the warm-up needs "
            f"{frontend.config.warmup_keyframes}; lower slam.droid.filter_threshold or give a longer clip"
        )
    for steps in GLOBAL_STEPS:
        adjust_globally(frontend, steps)
    return torch.cat(list(_fill(frontend, images)))


def adjust_globally(frontend: DroidFrontend, steps: int) -> None:
    """Bundle adjustment of all keyframes over edges between all close ones, the first pose fixed."""
    frames, model, n = frontend.keyframes, frontend.model, len(frontend.keyframes)
    _normalise(frontend)
    pairs = _global_pairs(frontend)
    device = frames.poses.device
    ii, jj = (torch.from_numpy(np.ascontiguousarray(pairs[:, side])).to(device) for side in (0, 1))
    layout = BundleLayout(pairs[:, 0], pairs[:, 1], 1, n, device)
    grid = pixel_grid(*frames.shape, device)
    hidden = frames.hidden[ii]
    target, _ = reproject(frames.poses, frames.disparities, frames.intrinsics, ii, jj)
    weight = torch.zeros_like(target)
    parts = [np.flatnonzero(pairs[:, 0] // _SOURCES_AT_ONCE == k) for k in range(n // _SOURCES_AT_ONCE + 1)]
    for _ in range(steps):
        coords, _ = reproject(frames.poses, frames.disparities, frames.intrinsics, ii, jj)
        motion = torch.cat([coords - grid, target - coords], dim=-1).permute(0, 3, 1, 2)
        for part in filter(len, parts):
            edges = torch.from_numpy(part).to(device)
            i, j = ii[edges], jj[edges]
            lookup = model.correlation(frames.features[i], frames.features[j], False).lookup(coords[edges])
            hidden[edges], delta, weight[edges] = model.refine(hidden[edges], frames.inp[i], lookup, motion[edges])
            target[edges] = coords[edges] + delta
            sources, source_of = np.unique(pairs[part, 0], return_inverse=True)
            group = torch.from_numpy(source_of).to(device)
            frames.eta[torch.from_numpy(sources).to(device)] = model.damping(hidden[edges], group, len(sources))
        frames.poses, frames.disparities = bundle_adjust(
            frames.poses,
            frames.disparities,
            frames.intrinsics,
            target,
            weight,
            layout,
            eta=frames.eta[layout.frames],
            damping=GLOBAL_DAMPING,
            rule=frontend.rule,
        )


def _normalise(frontend: DroidFrontend) -> None:
    """Scale the world so that the mean inverse depth is one."""
    frames, n = frontend.keyframes, len(frontend.keyframes)
    mean = frames.disparities[:n].mean()
    frames.disparities[:n] /= mean
    frames.poses[:n, :3] *= mean


def _global_pairs(frontend: DroidFrontend) -> Pairs:
    frames, config, n = frontend.keyframes, frontend.config, len(frontend.keyframes)
    every = torch.arange(n, device=frames.poses.device)
    rows = [
        frame_distance(
            frames.poses, frames.disparities, frames.intrinsics, torch.full_like(every, i), every, config.beta
        )
        for i in range(n)
    ]
    rule = ProximityRule(config.backend_radius, config.backend_nms, config.backend_threshold, config.beta)
    none = np.zeros((0, 2), dtype=np.int64)
    return proximity_pairs(torch.stack(rows).cpu().numpy(), 0, 0, none, rule, _EDGES_PER_KEYFRAME * n)


def _fill(frontend: DroidFrontend, images: Iterable[tuple[int, Tensor]]) -> Iterator[Tensor]:
    """Poses (m, 7) of all frames, some at a time: interpolated, then refined against both neighbouring keyframes."""
    frames = frontend.keyframes
    n = len(frames)
    while frames.capacity < n + _FRAMES_AT_ONCE:
        frames.grow()
    known = np.array(frames.stamps_ns)
    stream = iter(images)
    while batch := list(islice(stream, _FRAMES_AT_ONCE)):
        stamps = np.array([stamp for stamp, _ in batch])
        # Frames behind the last keyframe extrapolate its motion, as the causal read-out does.
        before = np.clip(np.searchsorted(known, stamps, side="right") - 1, 0, n - 2)
        after = before + 1
        fraction = (stamps - known[before]) / (known[after] - known[before])
        slots = np.arange(n, n + len(batch))
        device = frames.poses.device
        frames.poses[n : n + len(batch)] = frames.interpolated(
            torch.from_numpy(before).to(device),
            torch.from_numpy(after).to(device),
            torch.tensor(fraction[:, None], dtype=torch.float32, device=device),
        )
        frames.disparities[n : n + len(batch)] = 1.0
        for slot, (_, image) in zip(slots, batch, strict=True):
            frames.put_features(int(slot), frontend.model.features(image))
        graph = FactorGraph(frontend.model, frames, stored=frontend.stored, rule=frontend.rule)
        for neighbour in (before, after):
            graph.add(np.stack([neighbour, slots], axis=1))
        for _ in range(_FILL_UPDATES):
            graph.update(n, motion_only=True)
        yield frames.poses[n : n + len(batch)].clone()
