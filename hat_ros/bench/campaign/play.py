"""One clip of a campaign: rendered, tracked and scored in memory."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import cv2
import numpy as np

from hat_ros.app.pipeline import Pipeline, Processed
from hat_ros.array_types import Bool, Float, Int, UInt8
from hat_ros.bench.campaign.draw import CampaignClip
from hat_ros.bench.datasets.image_files import stamp_of
from hat_ros.bench.evaluation import metrics
from hat_ros.bench.evaluation.symmetric import nearest_truth
from hat_ros.bench.methods.framewise import Hat
from hat_ros.bench.synth.clips import render_clip, trajectory
from hat_ros.bench.synth.mismatch import apply_mismatch
from hat_ros.config import HatConfig
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry
from hat_ros.target.exact_symmetry import symmetry_of
from hat_ros.target.masks import overlap
from hat_ros.target.model import Target
from hat_ros.tracker import StageWrapper
from hat_ros.types import MASK_SILHOUETTE, Frame

Stage = TypeVar("Stage")

# The overlap of masks counts where the longer side of the true silhouette's box has this many pixels.
MIN_SIDE_PX = 30
# Hypotheses that "best of ten" looks at.
BEST_OF = 10


@dataclass(frozen=True, eq=False)
class Film:
    """The images of a clip and what is true of them.

    Attributes:
        frames: in order, each with its true silhouette as ``given_mask``.
        T_true: (N, 4, 4) ``T_cam_target``.
    """

    frames: tuple[Frame, ...]
    T_true: Float


@dataclass(frozen=True, eq=False)
class Played:
    """What came out of a clip, frame by frame; every computed pose counts, whatever is published.

    Attributes:
        e_p: (N,) pose error to the nearest of the poses that look like the truth, NaN without a pose.
        e_p_plain: (N,) pose error to the truth itself, as the paper has it.
        rotation_deg: (N,) rotation error of the former kind, and so are those of the hypotheses.
        state: (N,) :class:`~hat_ros.types.TrackState` values.
        mask_iou: (N,) overlap of mask and true silhouette, 0 for a missing mask, NaN where the craft is too small.
        best_deg: (N,) rotation error of the best of ten hypotheses, NaN outside keyframes.
        inside_95: (N,) 1 where the truth lies inside the 95 % ellipsoid, 0 where not, NaN without one.
        segmentation_ms: (N,) processor time of Stage 1, of all threads; unlike wall time it does not depend on what
            else the machine does.
        frame_ms: (N,) processor time of the whole frame.
    """

    e_p: Float
    e_p_plain: Float
    rotation_deg: Float
    state: Int
    mask_iou: Float
    best_deg: Float
    inside_95: Float
    segmentation_ms: Float
    frame_ms: Float


def film_clip(clip: CampaignClip, target: Target) -> Film:
    """Render a clip of a craft; the images go through JPEG where the clip says so."""
    spec = clip.spec(target.diameter_m)
    poses = trajectory(spec, target)
    seen = apply_mismatch(target, clip.mismatch)
    frames = tuple(
        Frame(
            stamp_of(index),
            compressed(frame.rgb, spec.jpeg_quality),
            spec.camera,
            frame.mask.astype(np.uint8) * np.uint8(MASK_SILHOUETTE),
        )
        for index, frame in enumerate(render_clip(seen, spec, poses))
    )
    return Film(frames, poses)


def compressed(rgb: UInt8, quality: int) -> UInt8:
    """The image (H, W, 3) as JPEG of this quality leaves it; 0 = as it is."""
    if not quality:
        return rgb
    data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.ascontiguousarray(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)[..., ::-1])


def play_clip(film: Film, target: Target, config: HatConfig, masks_given: bool) -> Played:
    """Track a clip with the method of ``hat track``, one frame in flight, and compare with the truth.

    Args:
        film: the clip.
        target: the CAD model that the tracker is given.
        config: of all stages.
        masks_given: frames bring their true silhouettes.
    """
    frames = film.frames if masks_given else (replace(frame, given_mask=None) for frame in film.frames)
    clock = _StageClock("segmentation")
    done = list(Pipeline(lambda wrap: Hat(config, target, clock.inside(wrap))).run(frames))
    estimates = [item.step.estimate for item in done]
    T_est = lie.matrix_from_row(np.array([estimate.pose_row for estimate in estimates]))
    symmetry = symmetry_of(target)
    T_equal = nearest_truth(T_est, film.T_true, symmetry)
    errors = metrics.pose_errors(T_est, T_equal)
    covariance = np.array([estimate.covariance for estimate in estimates])
    judged = errors.scored & np.isfinite(covariance).all(axis=(-1, -2))
    inside = np.full(len(done), np.nan)
    inside[judged] = metrics.inside_ellipsoid(T_est, covariance, T_equal)
    return Played(
        e_p=errors.pose,
        e_p_plain=metrics.pose_errors(T_est, film.T_true).pose,
        rotation_deg=np.degrees(errors.rotation_rad),
        state=np.array([int(estimate.state) for estimate in estimates]),
        mask_iou=np.array(list(_overlaps(film, done))),
        best_deg=_best_deg(done, film.T_true, symmetry),
        inside_95=inside,
        segmentation_ms=np.array(clock.ms),
        frame_ms=np.array([item.cpu_ms for item in done]),
    )


class _StageClock:
    """Processor time of each call of one stage; with one frame in flight no other stage works meanwhile."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.ms: list[float] = []

    def inside(self, wrap: StageWrapper) -> StageWrapper:
        """The same wrapper around stages of which this one is timed."""

        def timed(name: str, stage: Stage) -> Stage:
            return wrap(name, cast("Stage", _Timed(stage, self.ms)) if name == self._name else stage)

        return timed


class _Timed:
    """A stage whose ``update`` is timed; everything else is the stage's own."""

    def __init__(self, stage: Any, ms: list[float]) -> None:
        self._stage, self._ms = stage, ms

    def update(self, *arguments: Any) -> Any:
        start = time.process_time()
        try:
            return self._stage.update(*arguments)
        finally:
            self._ms.append(1e3 * (time.process_time() - start))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stage, name)


def _overlaps(film: Film, done: list[Processed]) -> Iterator[float]:
    for frame, item in zip(film.frames, done, strict=True):
        silhouette = np.asarray(frame.given_mask == MASK_SILHOUETTE)
        if _longer_side_px(silhouette) < MIN_SIDE_PX:
            yield float("nan")
        else:
            detection = item.step.detection
            yield 0.0 if detection is None else overlap(detection.mask, silhouette)


def _longer_side_px(mask: Bool) -> int:
    return max(cv2.boundingRect(mask.view(np.uint8))[2:])


def _best_deg(done: list[Processed], T_true: Float, symmetry: Symmetry) -> Float:
    """Candidates come best first; those of a frame that is no keyframe are none."""
    truth = T_true[:, :3, :3]
    found = [item.step.candidates.nearest(symmetry, R) for item, R in zip(done, truth, strict=True)]
    rows = [candidates.pose_rows[:BEST_OF] for candidates in found]
    best = metrics.best_of_k_deg(rows, T_true)
    return np.where([item.step.estimate.keyframe for item in done], best, np.nan)
