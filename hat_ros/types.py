"""What flows between the stages: frame -> detection -> candidates -> motion -> selection -> estimate.

Every type holds exactly what its topic carries (see ``docs/topics.md``), in the same float64 bits, so a stage cannot
tell whether its input came through memory or through DDS. Poses are kept as rows ``[x y z qx qy qz qw]`` (metres, unit
quaternion); ``T_cam_target`` and friends are derived. All types are frozen; arrays in them are never written to.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property

import numpy as np

from hat_ros.array_types import Bool, Float, Int, UInt8
from hat_ros.errors import CandidateError, FrameError
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry

MAX_IMAGE_SIDE_PX = 8192
# Values of a given mask (``Frame.given_mask``), beside 0 for outside.
MASK_SILHOUETTE = 255
MASK_BOX = 128  # inside a box whose silhouette is unknown


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion; pixel centres lie at integer coordinates (OpenCV).

    Attributes:
        K: (3, 3) intrinsics ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` in pixels.
        width: image width in pixels.
        height: image height in pixels.

    Raises:
        FrameError: K is not finite, has a wrong form, or the size is absurd.
    """

    K: Float
    width: int
    height: int

    def __post_init__(self) -> None:
        K = np.asarray(self.K, dtype=np.float64)
        object.__setattr__(self, "K", K)
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise FrameError(f"camera matrix K must be 3x3 and finite, found shape {K.shape}: {K.tolist()}")
        if K[0, 0] <= 0 or K[1, 1] <= 0 or abs(K[2, 2] - 1) > 1e-9 or K[1, 0] or K[2, 0] or K[2, 1]:
            raise FrameError(f"camera matrix K must be [[fx,0,cx],[0,fy,cy],[0,0,1]] with fx, fy > 0: {K.tolist()}")
        if not (0 < self.width <= MAX_IMAGE_SIDE_PX and 0 < self.height <= MAX_IMAGE_SIDE_PX):
            raise FrameError(f"image size must be 1 to {MAX_IMAGE_SIDE_PX} px a side: {self.width}x{self.height}")

    def project(self, points_cam: Float) -> Float:
        """Pixel coordinates of camera-frame points with z > 0: (..., 3) m -> (..., 2) px."""
        xy = points_cam[..., :2] / points_cam[..., 2:3]
        uv = np.empty_like(xy)
        uv[..., 0] = self.K[0, 0] * xy[..., 0] + self.K[0, 1] * xy[..., 1] + self.K[0, 2]
        uv[..., 1] = self.K[1, 1] * xy[..., 1] + self.K[1, 2]
        return uv

    def crop(self, x0: int, y0: int, width: int, height: int, scale: float = 1.0) -> Camera:
        """The camera of the crop starting at pixel (x0, y0), then resized by ``scale`` (area-preserving centres).

        A resize maps centre u to ``(u + 0.5) * scale - 0.5``.
        """
        K = self.K.copy()
        K[0, 2] -= x0
        K[1, 2] -= y0
        K[0, 2] = (K[0, 2] + 0.5) * scale - 0.5
        K[1, 2] = (K[1, 2] + 0.5) * scale - 0.5
        K[0, 0] *= scale
        K[0, 1] *= scale
        K[1, 1] *= scale
        return Camera(K, round(width * scale), round(height * scale))


@dataclass(frozen=True)
class Frame:
    """One admitted camera frame.

    Attributes:
        stamp_ns: exposure stamp in nanoseconds, the frame's identity.
        rgb: (H, W, 3) uint8.
        camera: calibration of this image.
        given_mask: (H, W) uint8 detection that came with the image, 255 = target silhouette, 128 = inside a box
            whose silhouette is unknown, 0 = outside; None when the recording brings none.
        scored: a pose is asked for; False: the frame only feeds motion, as a data set's protocol may want it.
    """

    stamp_ns: int
    rgb: UInt8
    camera: Camera
    given_mask: UInt8 | None = None
    scored: bool = True

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width, 3)
        if self.rgb.dtype != np.uint8 or self.rgb.shape != shape:
            raise FrameError(
                f"frame {self.stamp_ns}: image must be uint8 {shape} as camera_info says, "
                f"found {self.rgb.dtype} {self.rgb.shape}"
            )
        if self.given_mask is not None and self.given_mask.shape != shape[:2]:
            raise FrameError(f"frame {self.stamp_ns}: mask must be {shape[:2]}, found {self.given_mask.shape}")


@dataclass(frozen=True)
class Detection:
    """Where the target is in one frame (Stage 1).

    Attributes:
        mask: (H, W) bool, at least one pixel set.
        silhouette: True when the mask is the target's outline, False when it is only a filled box.
    """

    mask: Bool
    silhouette: bool = True

    @cached_property
    def box_xyxy(self) -> Float:
        """(4,) tight box of the mask in pixels, outer pixel edges (centre of the first pixel minus one half)."""
        rows, cols = np.flatnonzero(self.mask.any(axis=1)), np.flatnonzero(self.mask.any(axis=0))
        return np.array([cols[0] - 0.5, rows[0] - 0.5, cols[-1] + 0.5, rows[-1] + 0.5])

    @cached_property
    def area_px(self) -> int:
        """Number of mask pixels."""
        return int(np.count_nonzero(self.mask))

    def touches_border(self) -> bool:
        """Whether the mask reaches the image border, so that part of the target may lie outside."""
        m = self.mask
        return bool(m[0].any() or m[-1].any() or m[:, 0].any() or m[:, -1].any())


@dataclass(frozen=True)
class PosePrior:
    """What the fused poses of the past say about this frame; built by :class:`~hat_ros.tracking.prior.PriorBuffer`.

    Attributes:
        stamp_ns: stamp of the newest fused pose used, at least ``delay_frames`` frames before this one.
        pose_row: (7,) pose ``T_cam_target`` extrapolated to this frame at constant rate.
        fused_row: (7,) the fused pose at ``stamp_ns`` itself.
        healthy: the fused state there was TRACKING.
        supported: mask and contour there agreed with the pose: its silhouette is right even where the basin is open.
    """

    stamp_ns: int
    pose_row: Float
    fused_row: Float
    healthy: bool
    supported: bool

    @cached_property
    def T_cam_target(self) -> Float:
        """(4, 4) prediction for this frame."""
        return lie.matrix_from_row(self.pose_row)


@dataclass(frozen=True)
class Candidates:
    """Pose hypotheses of one frame (Stage 2), best appearance first; zero rows when there are none.

    Attributes:
        pose_rows: (K, 7) ``T_cam_target``.
        log_score: (K,) appearance score, higher is better; ``-inf`` marks a dropped candidate that keeps its slot.
        box_xyxy: (4,) detection box in pixels, NaN when there is no detection.
        rank: (K,) place among what the estimator chose from before it refined and scored again, from 0; given none,
            the order of the candidates. With a smaller K it would have refined those of lower rank alone.
    """

    pose_rows: Float
    log_score: Float
    box_xyxy: Float = field(default_factory=lambda: np.full(4, np.nan))
    rank: Int = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        if not len(self.rank):
            object.__setattr__(self, "rank", np.arange(len(self.log_score)))
        if self.pose_rows.ndim != 2 or self.pose_rows.shape[1] != 7 or self.log_score.shape != self.pose_rows.shape[:1]:
            raise CandidateError(
                f"candidates need pose_rows (K, 7) and log_score (K,), found {self.pose_rows.shape} and "
                f"{self.log_score.shape}"
            )
        if self.rank.shape != self.log_score.shape:
            raise CandidateError(f"candidates need rank ({len(self.log_score)},), found {self.rank.shape}")

    @classmethod
    def none(cls) -> Candidates:
        """No candidates: the frame is no keyframe, or nothing was found."""
        return cls(np.zeros((0, 7)), np.zeros(0))

    @classmethod
    def from_matrices(
        cls, T_cam_target: Float, log_score: Float, box_xyxy: Float | None = None, rank: Int | None = None
    ) -> Candidates:
        """Candidates from (K, 4, 4) poses, (K,) scores and ranks, sorted best score first (stable)."""
        log_score = np.asarray(log_score, dtype=np.float64)
        order = np.argsort(-log_score, kind="stable")
        rows = lie.row_from_matrix(np.asarray(T_cam_target, dtype=np.float64).reshape(-1, 4, 4))[order]
        box_xyxy = np.full(4, np.nan) if box_xyxy is None else np.asarray(box_xyxy, float)
        return cls(rows, log_score[order], box_xyxy, np.arange(len(order)) if rank is None else rank[order])

    def __len__(self) -> int:
        return len(self.log_score)

    def first(self, k: int) -> Candidates:
        """What the estimator would have given for K = k."""
        if len(self) <= k and self.rank.max(initial=-1) < k:
            return self
        keep = self.rank < k
        return Candidates(self.pose_rows[keep], self.log_score[keep], self.box_xyxy, self.rank[keep])

    @cached_property
    def T_cam_target(self) -> Float:
        """(K, 4, 4) poses."""
        return lie.matrix_from_row(self.pose_rows)

    def nearest(self, symmetry: Symmetry, R_reference: Float | None) -> Candidates:
        """The same candidates, each as the pose that looks like it and is nearest to a rotation (3, 3).

        Poses that no image can tell apart are then one. None: the rotation of the best candidate. NaN: unchanged.
        """
        alive = np.isfinite(self.log_score)
        if symmetry.is_trivial or not alive.any():
            return self
        if R_reference is not None and not np.isfinite(R_reference).all():
            return self
        T = self.T_cam_target[alive]
        reference = T[np.argmax(self.log_score[alive]), :3, :3] if R_reference is None else R_reference
        rows = self.pose_rows.copy()
        rows[alive] = lie.row_from_matrix(symmetry.nearest(T, reference))
        return replace(self, pose_rows=rows)

    def lead(self, apart_deg: float) -> float:
        """Lead in log score of the best one's basin over the best outside it, as :meth:`Selection.margin`."""
        if not np.isfinite(self.log_score).any():
            return float("nan")
        best = int(np.argmax(self.log_score))
        return self.lead_of(self.T_cam_target[best, :3, :3], self.log_score, apart_deg)

    def lead_of(self, R_cam_target: Float, score: Float, apart_deg: float) -> float:
        """Lead in a score (K,) of the candidates within an angle of an orientation (3, 3) over all others."""
        near = lie.angle_between(self.T_cam_target[:, :3, :3], R_cam_target) <= np.radians(apart_deg)
        return float(score[near].max(initial=-np.inf) - score[~near].max(initial=-np.inf))


@dataclass(frozen=True)
class Motion:
    """Target-relative camera state of one frame: ``T_slam_cam`` in an arbitrary gauge and scale.

    Attributes:
        valid: False means "no motion known", never identity.
        epoch: counts restarts; increments across epochs mean nothing.
        pose_row: (7,) ``T_slam_cam``, NaN when not valid.
        n_keyframes: keyframes held by the estimator.
        sigma_rad: one-sigma rotation uncertainty of the step from the previous frame; for people (odometry
            covariance), never used downstream. NaN when unknown.
    """

    valid: bool
    epoch: int
    pose_row: Float
    n_keyframes: int = 0
    sigma_rad: float = float("nan")

    @classmethod
    def none(cls, epoch: int = 0, n_keyframes: int = 0) -> Motion:
        """No motion known for this frame."""
        return cls(False, epoch, np.full(7, np.nan), n_keyframes)

    @cached_property
    def T_slam_cam(self) -> Float:
        """(4, 4) camera pose in the SLAM frame."""
        return lie.matrix_from_row(self.pose_row)


@dataclass(frozen=True)
class RotationPrior:
    """What is known of a rotation before the image is looked at.

    Attributes:
        R_cam_target: (3, 3) the expected rotation.
        information: (3, 3) of the rotation vector r in ``R = exp(r) R_cam_target``, camera axes, 1/rad^2.
    """

    R_cam_target: Float
    information: Float


@dataclass(frozen=True)
class Selection:
    """The decoder's answer for one frame (Stage 3).

    Attributes:
        candidates: the candidates it chose from (zero rows when the frame is no keyframe).
        scaled_score: (K,) eq. (appearance)/(sizew).
        path_score: (K,) forward scores V_j(k), eq. (forward), largest of them zero.
        selected: index of the anchor, -1 when there is none.
    """

    candidates: Candidates
    scaled_score: Float
    path_score: Float
    selected: int = -1

    @classmethod
    def none(cls) -> Selection:
        """No keyframe at this frame."""
        return cls(Candidates.none(), np.zeros(0), np.zeros(0), -1)

    def margin(self, R_cam_target: Float, apart_deg: float) -> float:
        """Lead in path score of an orientation's basin over the best candidate outside it.

        Args:
            R_cam_target: (3, 3) orientation, not necessarily a candidate's.
            apart_deg: candidates further than this from it stand in other basins.

        Returns:
            The lead; infinite when there is no other basin, minus infinity when no candidate stands in this one, NaN
            without surviving candidates.
        """
        return self._lead(self.path_score, R_cam_target, apart_deg)

    def appearance_margin(self, R_cam_target: Float, apart_deg: float) -> float:
        """The same lead in appearance alone, eq. (appearance)/(sizew), which owes nothing to earlier keyframes."""
        return self._lead(self.scaled_score, R_cam_target, apart_deg)

    def _lead(self, score: Float, R_cam_target: Float, apart_deg: float) -> float:
        if self.selected < 0:
            return float("nan")
        return self.candidates.lead_of(R_cam_target, score, apart_deg)

    @property
    def anchor(self) -> Float | None:
        """(4, 4) the selected ``T_cam_target``, or None."""
        return self.candidates.T_cam_target[self.selected] if self.selected >= 0 else None


@dataclass(frozen=True)
class Refined:
    """A pose refined on one image.

    Attributes:
        pose_row: (7,) ``T_cam_target``.
        covariance: (6, 6) of ``[translation (m); rotation vector (rad)]``, as in :class:`Estimate`.
        overlap: intersection over union of the rendered silhouette and the mask, NaN without a silhouette mask.
        support: share of the visible contour whose image evidence agrees with the pose, 0 to 1.
        visible_overlap: the overlap where the image is bright enough to tell: silhouette without mask counts by its
            brightness, because the shadowed side of a target is black on black. NaN without a silhouette mask.
        misfit_px: mean distance of the visible outlines of silhouette and mask beyond what a good mask leaves; a
            systematic error, of which the covariance knows nothing.
    """

    pose_row: Float
    covariance: Float
    overlap: float
    support: float
    visible_overlap: float = float("nan")
    misfit_px: float = 0.0

    @cached_property
    def T_cam_target(self) -> Float:
        """(4, 4) pose."""
        return lie.matrix_from_row(self.pose_row)

    @property
    def quality(self) -> float:
        """Image evidence for the pose, 0 to 1: mean of contour support and visible silhouette overlap.

        What is black on black is no evidence. Without a silhouette mask the contour counts alone.
        """
        return self.support if np.isnan(self.visible_overlap) else 0.5 * (self.support + self.visible_overlap)


class TrackState(IntEnum):
    """State of the output, as in the ``state`` column of ``/hat/status``."""

    UNINITIALISED = 0
    TRACKING = 1
    COASTING = 2
    LOST = 3
    INITIALISING = 4

    @property
    def has_pose(self) -> bool:
        """Whether there is a pose in this state."""
        return self.is_confirmed or self is TrackState.INITIALISING

    @property
    def is_confirmed(self) -> bool:
        """Whether the track is or was TRACKING since it was found."""
        return self in (TrackState.TRACKING, TrackState.COASTING)

    def is_published(self, with_initialising: bool) -> bool:
        """Whether the pose goes out on ``/target_pose``: a confirmed one, others on request."""
        return self.is_confirmed or (with_initialising and self.has_pose)


class StateReason(IntEnum):
    """Why the output has its state: the ``reason`` column of ``/hat/status``. Numbers keep their meaning for ever."""

    UNSTATED = 0
    CONFIRMED = 1
    NOT_FOUND = 2
    NOT_MEASURED = 3
    AMBIGUOUS = 4
    OUTSHONE = 5
    UNCONFIRMED = 6
    UNEXPLAINED = 7
    CONTRADICTED = 8
    GIVEN_UP = 9

    @property
    def words(self) -> str:
        """The reason for people."""
        return _REASON_WORDS[self]


_REASON_WORDS = {
    StateReason.UNSTATED: "the method states no reason",
    StateReason.CONFIRMED: "measured in this image, and no other orientation competes",
    StateReason.NOT_FOUND: "no pose has been found yet",
    StateReason.NOT_MEASURED: "this image does not support the pose: it is predicted or held",
    StateReason.AMBIGUOUS: "another orientation is about as likely",
    StateReason.OUTSHONE: "another orientation looked better at one of the last keyframes",
    StateReason.UNCONFIRMED: "neither the image nor a second keyframe has confirmed the orientation",
    StateReason.UNEXPLAINED: "no image so far was explained well, nor have three keyframes agreed",
    StateReason.CONTRADICTED: "successive keyframes contradict the pose",
    StateReason.GIVEN_UP: "no image has supported a pose for too long",
}


@dataclass(frozen=True)
class Alignment:
    """Sim(3) ``S_target_slam`` from SLAM to metric target coordinates, eq. (alignmentmap).

    Attributes:
        version: counts fits since the start of the run, from 1.
        scale: metres per SLAM unit.
        quat_xyzw: (4,) rotation R^A.
        translation_m: (3,) t^A.
        n_anchors: joint observations used by the fit.
        rms: root mean square residual of the fit (lambda-weighted, metres).
        epoch: SLAM epoch that it belongs to.
    """

    version: int
    scale: float
    quat_xyzw: Float
    translation_m: Float
    n_anchors: int
    rms: float
    epoch: int

    @cached_property
    def R_target_slam(self) -> Float:
        """(3, 3) rotation."""
        return lie.matrix_from_quat(self.quat_xyzw)

    def target_in_camera(self, T_slam_cam: Float) -> Float:
        """(4, 4) metric ``T_cam_target`` of a (4, 4) SLAM pose: S(A) of eq. (alignmentmap)."""
        R_target_cam = self.R_target_slam @ T_slam_cam[:3, :3]
        centre_m = self.scale * (self.R_target_slam @ T_slam_cam[:3, 3]) + self.translation_m
        return lie.transform(R_target_cam.T, -R_target_cam.T @ centre_m)


@dataclass(frozen=True)
class Estimate:
    """The output for one frame (Stage 4): what ``/hat/status`` and ``/target_pose`` carry.

    Attributes:
        stamp_ns: the frame's stamp.
        state: see :class:`TrackState`.
        pose_row: (7,) ``T_cam_target``, quaternion hemisphere-continuous with the previous output; NaN if none.
        covariance: (6, 6) of ``[translation (m); rotation vector (rad)]`` in the camera frame, with
            ``R_true = Exp(rotvec) R_est``; NaN if there is no pose.
        keyframe: candidates were available at this frame.
        n_candidates: how many.
        anchor: row of the selected candidate, -1 if none.
        gate_weight: g of eq. (fusionresiduals) at an anchor, NaN elsewhere.
        alignment: the Sim(3) in force after this frame, None before the first fit.
        slam_epoch: epoch of the motion used.
        gap_frames: frames since the last frame with a measurement of its own (0 = this one has).
        n_resets: alignment resets since the start of the run.
        margin: lead of the output's basin over all others at the last keyframe, in units of path score; NaN before
            the first. The smaller, the more ambiguous; for people (diagnostics) and the state.
        reason: why the state is what it is.
        order: number of orientations that look like this one, itself included: 1 without a symmetry of the target.
        free_axes: number of axes about which the target may be turned without a difference: 0, 1, or 3 for a ball.
    """

    stamp_ns: int
    state: TrackState
    pose_row: Float
    covariance: Float
    keyframe: bool = False
    n_candidates: int = 0
    anchor: int = -1
    gate_weight: float = float("nan")
    alignment: Alignment | None = None
    slam_epoch: int = 0
    gap_frames: int = 0
    n_resets: int = 0
    margin: float = float("nan")
    reason: StateReason = StateReason.UNSTATED
    order: int = 1
    free_axes: int = 0

    @cached_property
    def T_cam_target(self) -> Float:
        """(4, 4) pose, NaN if none."""
        return lie.matrix_from_row(self.pose_row)
