"""A coarse pose from navigation that narrows the search for a target which has not been found yet.

An operator or a relative-navigation filter knows roughly where the target is: a pose with a covariance, as in
``geometry_msgs/PoseWithCovariance``. Stage 1 then looks only where the target can be, and Stage 2 drops candidates that
the pose contradicts, both at 3 sigma. A target that has a pose of its own does not use it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import erf, gammaincinv

from hat_ros.array_types import Bool, Float
from hat_ros.config import HatConfig
from hat_ros.errors import ConfigError, InputError
from hat_ros.geometry import lie
from hat_ros.types import Camera, Candidates, PosePrior

SIGMAS = 3.0
# Share of a normal variable within so many sigma; the limit of several together holds the same share.
_SHARE = float(erf(SIGMAS / math.sqrt(2.0)))
# Depths at which the region is laid out, evenly in their logarithm: 6 % apart even over a range of a million to one.
_N_DEPTHS = 256
_QUAT_NORM_TOLERANCE = 1e-3  # as of candidates
# Of a covariance written with few digits, relative to its largest element.
_SYMMETRY_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Region:
    """Where an image can show a target.

    Attributes:
        center_xyxy: (4,) box of the pixels that the origin of the target's frame may be seen at; may reach beyond the
            image, and may be infinite.
        window_xyxy: (4,) whole pixels x0, y0, x1, y1 (the last two exclusive) inside the image that hold all of the
            target that the image can show; empty, x0 = x1 or y0 = y1, when it shows none.
        largest_px: longest side that the target's box can have, in pixels; may be infinite.
    """

    center_xyxy: Float
    window_xyxy: tuple[int, int, int, int]
    largest_px: float

    @property
    def is_empty(self) -> bool:
        """Whether the target is out of sight."""
        x0, y0, x1, y1 = self.window_xyxy
        return x0 >= x1 or y0 >= y1


@dataclass(frozen=True)
class InitialPose:
    """A coarse ``T_cam_target`` with its uncertainty.

    Attributes:
        pose_row: (7,) position in metres, unit quaternion xyzw.
        covariance: (6, 6) of ``[translation (m); rotation vector (rad)]`` in the camera frame, with
            ``R_true = Exp(rotvec) R``, as in :class:`~hat_ros.types.Estimate`. What is unknown has a variance beyond
            all that is possible: rotation about a direction is unknown from 60 degrees (1 sigma) on. Correlations
            between position and rotation are not used.

    Raises:
        InputError: not finite, no unit quaternion, a covariance that is not symmetric and positive definite, or a
            target that is certainly behind the camera.
    """

    pose_row: Float
    covariance: Float

    def __post_init__(self) -> None:
        row, covariance = np.asarray(self.pose_row, np.float64), np.asarray(self.covariance, np.float64)
        if row.shape != (7,) or not np.isfinite(row).all():
            raise InputError(f"initial pose: expected 7 finite numbers x y z qx qy qz qw, found {row.tolist()!s:.120}")
        if abs(np.linalg.norm(row[3:]) - 1.0) > _QUAT_NORM_TOLERANCE:
            raise InputError(f"initial pose: the quaternion must have norm 1, found {np.linalg.norm(row[3:]):.6g}")
        if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
            raise InputError(f"initial pose: the covariance must be 6 x 6 and finite, found shape {covariance.shape}")
        if np.abs(covariance - covariance.T).max() > _SYMMETRY_TOLERANCE * np.abs(covariance).max():
            raise InputError("initial pose: the covariance must be symmetric")
        for name, block in (("position", covariance[:3, :3]), ("rotation", covariance[3:, 3:])):
            least = float(np.linalg.eigvalsh(block)[0])
            if least <= 0.0:
                raise InputError(
                    f"initial pose: the covariance of the {name} must be positive definite, its least eigenvalue is "
                    f"{least:.3g}: give what is unknown a large variance, not zero"
                )
        if row[2] + SIGMAS * math.sqrt(covariance[2, 2]) <= 0.0:
            raise InputError(f"initial pose: the target is behind the camera, z = {row[2]:g} m and its sigma is small")
        object.__setattr__(self, "pose_row", row)
        object.__setattr__(self, "covariance", covariance)

    @classmethod
    def of(cls, config: HatConfig) -> InitialPose | None:
        """The one that the section ``initial_pose`` states, None when it states none.

        Raises:
            ConfigError: not the right numbers, or no possible pose.
        """
        texts = config.initial_pose
        if not texts.pose:
            if texts.sigma:
                raise ConfigError("initial_pose.sigma is given without initial_pose.pose: give x y z qx qy qz qw")
            return None
        row = _numbers("initial_pose.pose", texts.pose, (7,))
        spread = _numbers("initial_pose.sigma", texts.sigma, (6, 36))
        try:
            return cls(row, np.diag(spread**2) if len(spread) == 6 else spread.reshape(6, 6))
        except InputError as error:
            raise ConfigError(str(error)) from None

    @cached_property
    def R_cam_target(self) -> Float:
        """(3, 3) rotation."""
        return lie.matrix_from_quat(self.pose_row[3:])

    @cached_property
    def _axes(self) -> tuple[Float, Float]:
        """Principal sigmas (3,) of the rotation, ascending, and their axes as columns (3, 3)."""
        variance, axes = np.linalg.eigh(self.covariance[3:, 3:])
        return np.sqrt(variance), axes

    @property
    def n_free_axes(self) -> int:
        """Directions about which nothing is known of the rotation: its 3 sigma are half a turn or more."""
        return int(np.count_nonzero(self._axes[0] * SIGMAS >= math.pi))

    def as_start(self, stamp_ns: int) -> PosePrior | None:
        """A start for the search, doubtful as any unconfirmed prediction; None unless the whole rotation is known."""
        if self.n_free_axes:
            return None
        return PosePrior(stamp_ns, self.pose_row, self.pose_row, healthy=False, supported=False)

    def region(self, camera: Camera, reach_m: float) -> Region:
        """Where the target's frame and all of the target must be in an image, at 3 sigma.

        Args:
            camera: the image's.
            reach_m: largest distance of a point of the target from the origin of its frame.
        """
        position, P = self.pose_row[:3], self.covariance[:3, :3]
        sigma_z = math.sqrt(P[2, 2])
        # The camera is not inside the target.
        near_m = max(position[2] - SIGMAS * sigma_z, reach_m)
        far_m = max(position[2] + SIGMAS * sigma_z, near_m)
        z = np.geomspace(near_m, far_m, _N_DEPTHS)
        # Slices of the ellipsoid at these depths: their centres and half widths (n, 2).
        left = np.maximum(SIGMAS**2 - ((z - position[2]) / sigma_z) ** 2, 0.0)
        slope = P[:2, 2] / P[2, 2]
        center = position[:2] + (z - position[2])[:, None] * slope
        half = np.sqrt(np.maximum(np.diag(P)[:2] - slope * P[:2, 2], 0.0) * left[:, None])
        low, high = center - half, center + half
        of_center = _pixel_box(camera, low / z[:, None], high / z[:, None])
        edges_low, edges_high = _tangents(low, z, reach_m)[0], _tangents(high, z, reach_m)[1]
        x0, y0, x1, y1 = _pixel_box(camera, edges_low, edges_high)
        limits = np.array([camera.width, camera.height] * 2, dtype=np.float64)
        # A pixel more than its outermost point on each side.
        window = np.clip(np.array([np.floor(x0), np.floor(y0), np.ceil(x1) + 1, np.ceil(y1) + 1]), 0.0, limits)
        focal = np.array([camera.K[0, 0] + abs(camera.K[0, 1]), camera.K[1, 1]])
        widths = [np.subtract(*_tangents(side, z, reach_m)[::-1]) for side in (low, high)]
        a, b, c, d = (int(value) for value in window)
        return Region(of_center, (a, b, c, d), float(max((width * focal).max() for width in widths)))

    def admits(self, T_cam_target: Float) -> Bool:
        """Which poses (N, 4, 4) agree with this one at 3 sigma: in position, and in what of the rotation is known.

        Of a rotation that is unknown about one axis the tilt of that axis counts; of one unknown about two, nothing.
        """
        T = np.asarray(T_cam_target, np.float64).reshape(-1, 4, 4)
        ok: Bool = _within(T[:, :3, 3] - self.pose_row[:3], self.covariance[:3, :3])
        sigmas, axes = self._axes
        if self.n_free_axes > 1:
            return ok
        turn = T[:, :3, :3] @ self.R_cam_target.T
        if self.n_free_axes == 0:
            return ok & _within(lie.so3_log(turn), self.covariance[3:, 3:])
        # The tilt is what is left when the turn about the free axis is undone.
        tilt = turn @ np.swapaxes(_twist(turn, axes[:, 2]), 1, 2)
        return ok & _within(lie.so3_log(tilt) @ axes[:, :2], np.diag(sigmas[:2] ** 2))

    def keep(self, candidates: Candidates) -> Candidates:
        """The candidates that agree with it."""
        if not len(candidates):
            return candidates
        finite: Bool = np.all(np.isfinite(candidates.pose_rows), axis=1)
        rows = np.where(finite[:, None], candidates.pose_rows, np.array([0.0, 0, 0, 0, 0, 0, 1]))
        kept = finite & self.admits(lie.matrix_from_row(rows))
        if not kept.any():
            return Candidates.none()
        return Candidates(candidates.pose_rows[kept], candidates.log_score[kept], candidates.box_xyxy)


class Acquisition:
    """The initial pose that one stage goes by: from the frame on with which it comes, until the target has a pose.

    Where fused poses are not fed back (``prior.enabled`` off) it serves until the stage itself has found something.

    Args:
        config: the whole configuration; its ``initial_pose`` comes with the first frame.

    Raises:
        ConfigError: that is no possible pose.
    """

    def __init__(self, config: HatConfig) -> None:
        self._pose = InitialPose.of(config)
        self._fed_back = config.prior.enabled
        self._begun = False

    def at(self, prior: PosePrior | None, given: InitialPose | None = None) -> InitialPose | None:
        """What is in force at a frame with this prior, None for none; to be called once for each frame.

        What is ``given`` with the frame takes the place of what came before.
        """
        self._begun = True
        if given is not None:
            self._pose = given
        if prior is not None:
            self._pose = None
        return self._pose

    def found(self) -> None:
        """The stage has found what it looked for."""
        if not self._fed_back:
            self._pose = None

    def reset(self) -> None:
        """A new search begins; what was known before is old, unless no frame has come yet."""
        if self._begun:
            self._pose = None


def _numbers(name: str, text: str, counts: tuple[int, ...]) -> Float:
    """Numbers separated by blanks or commas.

    Raises:
        ConfigError: something else, or not so many.
    """
    words = text.replace(",", " ").split()
    try:
        values = np.array([float(word) for word in words], dtype=np.float64)
    except ValueError:
        raise ConfigError(f"{name}: expected numbers separated by blanks, found '{text:.80}'") from None
    if len(values) not in counts:
        raise ConfigError(
            f"{name}: expected {' or '.join(map(str, counts))} numbers, found {len(values)}: '{text:.80}'"
        )
    return values


def _within(error: Float, covariance: Float) -> Bool:
    """Whether errors (N, n) are inside the ellipsoid that holds as large a share as 3 sigma of one variable."""
    n = error.shape[1]
    distance2 = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error.T).T)
    inside: Bool = distance2 <= 2.0 * gammaincinv(0.5 * n, _SHARE)
    return inside


def _twist(R: Float, axis: Float) -> Float:
    """The turn about an axis (3,) in rotations (N, 3, 3), so that what is left before it is a tilt of that axis."""
    quat = lie.quat_from_matrix(R)
    angle = 2.0 * np.arctan2(quat[:, :3] @ axis, quat[:, 3])
    return lie.so3_exp(angle[:, None] * axis)


def _tangents(offset: Float, z: Float, radius: float) -> tuple[Float, Float]:
    """Where a sphere's outline is seen, as tangents per axis (n, 2): offsets (n, 2) and depths (n,) of its centre."""
    direction = np.arctan2(offset, z[:, None])
    half = np.arcsin(np.minimum(radius / np.hypot(offset, z[:, None]), 1.0))
    quarter = 0.5 * np.pi
    low, high = direction - half, direction + half
    with np.errstate(invalid="ignore"):
        return (
            np.where(low <= -quarter, -np.inf, np.tan(np.maximum(low, -quarter))),
            np.where(high >= quarter, np.inf, np.tan(np.minimum(high, quarter))),
        )


def _pixel_box(camera: Camera, low: Float, high: Float) -> Float:
    """(4,) box of pixels that holds all directions between tangents (n, 2) and (n, 2)."""
    K = camera.K
    skew = sorted((K[0, 1] * low[:, 1].min(), K[0, 1] * high[:, 1].max())) if K[0, 1] else (0.0, 0.0)
    (x0, y0), (x1, y1) = low.min(axis=0), high.max(axis=0)
    return np.array(
        [
            K[0, 0] * x0 + skew[0] + K[0, 2],
            K[1, 1] * y0 + K[1, 2],
            K[0, 0] * x1 + skew[1] + K[0, 2],
            K[1, 1] * y1 + K[1, 2],
        ]
    )
