"""The offline reference: the observations of HAT, smoothed over the whole clip. Never causal.

After the paper's "Causal and Offline Performance Comparison": motion by global bundle adjustment where the backend can
(DROID-SLAM), the decoder's path traced back, one decision of the gate over the whole sequence, all poses optimised
jointly, then dense refinement of every frame (:mod:`hat_ros.bench.methods.dense`), which never leaves the basin of the
anchors. Here the refined poses are measurements, as they are for the causal method: a last joint optimisation ties them
to each other by the motion. Without refinement in the configuration the poses of the anchors stand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import overload

import cv2
import numpy as np

from hat_ros.array_types import Bool, Float, UInt8
from hat_ros.bench.methods.dense import DenseRefinement
from hat_ros.bench.methods.framewise import Hat
from hat_ros.bench.methods.smoothing import smooth_anchors, smooth_measured
from hat_ros.config import HatConfig
from hat_ros.geometry import lie
from hat_ros.motion.stage import suppress_background
from hat_ros.stages import whole_clip_motions_of
from hat_ros.target.model import Target
from hat_ros.tracker import StageWrapper, Step
from hat_ros.types import Camera, Detection, Estimate, Frame, Motion, StateReason, TrackState

_NO_COVARIANCE = np.full((6, 6), np.nan)


class Offline:
    """HAT's stages frame by frame, and the answer to all frames at the end."""

    causal = False
    concurrent = False

    def __init__(self, config: HatConfig, target: Target, wrap: StageWrapper) -> None:
        self._config = config
        self._hat = Hat(config, target, wrap)
        hypotheses = self._hat.hypotheses
        self._dense = DenseRefinement(config.refinement, target, hypotheses) if config.refinement.enabled else None
        self._whole_clip_motions = whole_clip_motions_of(config)
        self._steps: list[Step] = []
        self._images = _StoredClip(config.slam.masked)

    def step(self, frame: Frame) -> Step:
        """Observe; the estimate in the returned step is the causal one."""
        step = self._hat.step(frame)
        self._steps.append(replace(step, detection=None))
        if self._dense is not None or self._whole_clip_motions is not None:
            self._images.append(frame, step.detection)
        return step

    def finish(self) -> list[Estimate]:
        """Adjust globally, decode, align, optimise jointly; refine on the images, and optimise again."""
        steps = self._steps
        if not steps:
            return []
        motions = self._motions()
        result = smooth_anchors([step.candidates for step in steps], motions, self._config)
        T_final, covariances = result.T_cam_target, [_NO_COVARIANCE] * len(steps)
        if self._dense is not None:
            T_final = self._best_known(T_final, result.tied)
            measured = [
                self._dense.measure(*self._images.load(index), T, self._steps[index].estimate)
                for index, T in enumerate(T_final)
            ]
            covariances = [covariance for _, covariance in measured]
            smooth = smooth_measured(np.stack([T for T, _ in measured]), motions, self._config)
            T_final = np.where(np.isfinite(smooth), smooth, T_final)
        estimates = []
        for index, (step, T, covariance) in enumerate(zip(steps, T_final, covariances, strict=True)):
            known = bool(np.isfinite(T).all())
            estimates.append(
                replace(
                    step.estimate,
                    state=TrackState.TRACKING if known else TrackState.LOST,
                    pose_row=lie.row_from_matrix(T) if known else np.full(7, np.nan),
                    covariance=covariance,
                    anchor=int(result.chosen[index]),
                    gate_weight=float(result.gate_weight[index]),
                    gap_frames=0,
                    reason=StateReason.UNSTATED,
                )
            )
        return estimates

    def _motions(self) -> list[Motion]:
        """Adjusted over the whole clip where the backend can; not for a clip on which it never started."""
        causal = [step.motion for step in self._steps]
        if self._whole_clip_motions is None or not any(motion.valid for motion in causal):
            return causal
        return self._whole_clip_motions(self._config, self._images)

    def _best_known(self, T_decided: Float, tied: Bool) -> Float:
        """Poses (N, 4, 4): the decided ones, and the causal ones where no motion ties the decided to other frames.

        There the whole clip tells no more than the frames before did.
        """
        out = T_decided.copy()
        for index in np.flatnonzero(~tied):
            causal = self._steps[index].estimate
            if causal.state.has_pose:
                out[index] = causal.T_cam_target
        return out


class _StoredClip(Sequence[tuple[Frame, "Detection | None"]]):
    """All frames in little memory; as a sequence they are what the motion stage's backend sees."""

    def __init__(self, masked: bool) -> None:
        self._masked = masked
        self._images: list[_StoredImage] = []

    def __len__(self) -> int:
        return len(self._images)

    @overload
    def __getitem__(self, index: int) -> tuple[Frame, Detection | None]: ...

    @overload
    def __getitem__(self, index: slice) -> list[tuple[Frame, Detection | None]]: ...

    def __getitem__(self, index: int | slice) -> tuple[Frame, Detection | None] | list[tuple[Frame, Detection | None]]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        frame, detection = self._images[index].load()
        if self._masked and detection is not None:
            frame = replace(frame, rgb=suppress_background(frame.rgb, detection.mask))
        return frame, detection

    def append(self, frame: Frame, detection: Detection | None) -> None:
        """Keep one more."""
        self._images.append(_StoredImage.of(frame, detection))

    def load(self, index: int) -> tuple[Frame, Detection | None]:
        """One frame as it came."""
        return self._images[index].load()


@dataclass(frozen=True)
class _StoredImage:
    """A frame and its detection, compressed without loss."""

    stamp_ns: int
    camera: Camera
    png: UInt8
    mask_bits: UInt8 | None
    silhouette: bool

    @classmethod
    def of(cls, frame: Frame, detection: Detection | None) -> _StoredImage:
        png = np.asarray(cv2.imencode(".png", frame.rgb, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1], np.uint8)
        bits = None if detection is None else np.packbits(detection.mask)
        return cls(frame.stamp_ns, frame.camera, png, bits, detection is not None and detection.silhouette)

    def load(self) -> tuple[Frame, Detection | None]:
        frame = Frame(self.stamp_ns, np.asarray(cv2.imdecode(self.png, cv2.IMREAD_COLOR), np.uint8), self.camera)
        if self.mask_bits is None:
            return frame, None
        shape = (self.camera.height, self.camera.width)
        mask = np.unpackbits(self.mask_bits, count=shape[0] * shape[1]).reshape(shape).astype(bool)
        return frame, Detection(mask, self.silhouette)
