"""Front end of DROID-SLAM: motion filter, keyframes, local bundle adjustment, and a causal pose for every frame.

Sequence of operations and their constants: arXiv:2108.10869, section 3.4, with the settings of the released tracker.
All poses here map world points into the camera; :mod:`hat_ros.motion.droid` turns them round.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from hat_ros.config import DroidConfig
from hat_ros.motion.droid_graph import FactorGraph, ProximityRule, neighbour_pairs
from hat_ros.motion.droid_keyframes import FlowModel, Keyframes
from hat_ros.nets.droid_ba import EXACT_RULE, PUBLISHED_RULE
from hat_ros.nets.droid_geometry import pixel_grid

_INITIAL_RADIUS = 3
_INITIAL_UPDATES = 8
_INITIAL_NMS = 2
_INITIAL_BETA = 0.25
_INITIAL_TAIL = 4
_MAX_AGE = 20
_RECENT = 5
_UPDATES_PER_KEYFRAME = 3
_MORE_UPDATES = 2
# Slots beyond the window: what edges of the last updates may still touch, and room to move in large steps.
_SPARE_SLOTS = 32


class DroidFrontend:
    """Tracks one camera; a new one is made for every epoch.

    Args:
        config: the settings.
        model: the flow network.
        intrinsics: (4,) ``fx fy cx cy`` in units of 8 pixels, on the device to use.
        shape: (h, w) of the images divided by 8.
        keep_all: never retire keyframes (smoothing over the whole clip needs them all).
        stored: keep correlation volumes of the active edges.
    """

    def __init__(
        self,
        config: DroidConfig,
        model: FlowModel,
        intrinsics: Tensor,
        shape: tuple[int, int],
        *,
        keep_all: bool = False,
        stored: bool = True,
    ) -> None:
        self.config, self.model, self.keep_all, self.stored = config, model, keep_all, stored
        self.rule = PUBLISHED_RULE if config.as_released else EXACT_RULE
        capacity = max(config.warmup_keyframes, config.frontend_window) + _SPARE_SLOTS
        self.keyframes = Keyframes(capacity, intrinsics, shape, model.dtype)
        self.graph = FactorGraph(model, self.keyframes, stored=stored, rule=self.rule)
        self.initialised = False
        self._grid = pixel_grid(*shape, intrinsics.device)[None]
        self._last_context: tuple[Tensor, Tensor] | None = None

    def track(self, stamp_ns: int, image_bgr: Tensor) -> Tensor | None:
        """Advance by one frame.

        Args:
            stamp_ns: stamp, later than that of the frame before.
            image_bgr: (1, 3, H, W) uint8, background already suppressed.

        Returns:
            (7,) ``T_cam_world`` of this frame, None before initialisation.
        """
        features = self.model.features(image_bgr)
        is_keyframe = self.motion_score(features) > self.config.filter_threshold
        if is_keyframe:
            self._make_room()
            self._append(stamp_ns, features, image_bgr)
            self._optimise()
        if not self.initialised:
            return None
        if is_keyframe:
            return self.keyframes.poses[len(self.keyframes) - 1]
        return self.read_out(stamp_ns, features)

    def motion_score(self, features: Tensor) -> float:
        """Mean flow from the last keyframe after one update, in units of 8 pixels; infinite before the first keyframe.

        Waits for the device.
        """
        if self._last_context is None:
            return float("inf")
        frames, last = self.keyframes, slice(len(self.keyframes) - 1, len(self.keyframes))
        correlation = self.model.correlation(frames.features[last], features, self.stored)
        _, delta, _ = self.model.refine(*self._last_context, correlation.lookup(self._grid), None)
        return float(delta.norm(dim=-1).mean())

    def read_out(self, stamp_ns: int, features: Tensor) -> Tensor:
        """Pose (7,) of a frame that is no keyframe, from the last two keyframes; leaves no trace."""
        frames, slot = self.keyframes, len(self.keyframes)
        touched = slice(slot - 2, slot + 1)
        before = [tensor[touched].clone() for tensor in (frames.poses, frames.disparities, frames.eta)]
        earlier, last = frames.stamps_ns[-2:]
        fraction = 1.0 + (stamp_ns - last) / (last - earlier)
        frames.poses[slot] = frames.interpolated(slot - 2, slot - 1, fraction)
        frames.disparities[slot] = 1.0
        frames.put_features(slot, features)
        graph = FactorGraph(self.model, frames, stored=self.stored, rule=self.rule, inactive_margin=frames.capacity)
        graph.add(np.array([[slot - 1, slot], [slot - 2, slot]]))
        motion_only = not self.config.readout_depths
        if not motion_only:
            graph.borrow(self.graph, slot - 2)
        for _ in range(self.config.readout_updates):
            graph.update(slot, use_inactive=not motion_only, motion_only=motion_only)
        pose = frames.poses[slot].clone()
        for tensor, values in zip((frames.poses, frames.disparities, frames.eta), before, strict=True):
            tensor[touched] = values
        return pose

    def _append(self, stamp_ns: int, features: Tensor, image_bgr: Tensor) -> None:
        hidden, inp = self._last_context = self.model.context(image_bgr)
        if self.config.as_released and not len(self.keyframes):
            # The released tracker stores the first frame's context with its first channel in place of all of them.
            hidden, inp = hidden[:, :1].expand_as(hidden), inp[:, :1].expand_as(inp)
        self.keyframes.append(stamp_ns, features, hidden, inp)

    def _optimise(self) -> None:
        n = len(self.keyframes)
        if self.initialised:
            self._update()
        elif n == self.config.warmup_keyframes:
            self._initialise()

    def _initialise(self) -> None:
        """First bundle adjustment, over all keyframes of the warm-up."""
        config, graph, n = self.config, self.graph, len(self.keyframes)
        graph.add(neighbour_pairs(0, n, _INITIAL_RADIUS))
        for _ in range(_INITIAL_UPDATES):
            graph.update(1, use_inactive=True)
        rule = ProximityRule(config.frontend_radius, _INITIAL_NMS, config.frontend_threshold, _INITIAL_BETA)
        graph.add_by_proximity(0, 0, rule)
        for _ in range(_INITIAL_UPDATES):
            graph.update(1, use_inactive=True)
        self.keyframes.predict_next(config.motion_damping)
        self.initialised = True
        if not config.as_released:
            # One fixed pose leaves the scale free to wander from keyframe to keyframe; two hold it.
            graph.n_fixed = 2
        graph.drop(graph.ii < n - _INITIAL_TAIL, retire=True)

    def _update(self) -> None:
        """Take a new keyframe into the graph, and drop the one before last if it moved too little."""
        config, graph, n = self.config, self.graph, len(self.keyframes)
        graph.drop(graph.age > _MAX_AGE, retire=True)
        rule = ProximityRule(config.frontend_radius, config.frontend_nms, config.frontend_threshold, config.beta)
        graph.add_by_proximity(n - _RECENT, max(n - config.frontend_window, 0), rule, make_room=True)
        for _ in range(_UPDATES_PER_KEYFRAME):
            graph.update(use_inactive=True)
        moved = graph.distance(np.array([n - 4]), np.array([n - 2]), config.beta)[0]
        if moved < 2 * config.keyframe_threshold:
            graph.remove_keyframe(n - 3)
        else:
            for _ in range(_MORE_UPDATES):
                graph.update(use_inactive=True)
        self.keyframes.predict_next(config.motion_damping)

    def _make_room(self) -> None:
        """Free slots for one more keyframe and the guess behind it."""
        frames = self.keyframes
        if len(frames) + 2 <= frames.capacity:
            return
        if self.keep_all:
            frames.grow()
            return
        oldest = min(self.graph.oldest_needed(), len(frames) - self.config.frontend_window)
        self.graph.retire_keyframes(oldest)
