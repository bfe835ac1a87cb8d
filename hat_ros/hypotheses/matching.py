"""Which views of the bank have the shape of a mask: all directions, in-plane angles, shifts and scales at once.

The mask is laid on the bank's polar grid about an assumed centre and size. Overlap with every view at every in-plane
angle is then one small complex matrix product per angular frequency and one inverse transform. A whole mask has one
such assumption, its own centroid and radius of gyration; a mask that is cut by the image border or lacks dark parts
has several, and all go through the same product.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hat_ros.array_types import Bool, Float, Float32
from hat_ros.geometry import lie
from hat_ros.hypotheses.lit_bank import subdued
from hat_ros.target.masks import Moments, image_moments, mask_moments
from hat_ros.target.polar import MAX_RADIUS, N_RINGS, PolarSampler, border_grid, polar_grid, ring_weights
from hat_ros.target.view_bank import ViewBank
from hat_ros.types import Camera

# What silhouette without mask costs, against mask without silhouette = 1. A part that lies in shadow or outside the
# detector's reach is missing from the mask; mask where there is no target is rarer.
MISSING_WEIGHT = 0.5

# So many best scores are sorted, the larger number where the smaller holds too few distinct orientations.
_SORTED_COUNTS = (1024, 4096)
# Where the centroid of a cut silhouette may lie, in radii of gyration of what is seen, and its size relative to it.
_CUT_ASSUMPTIONS = tuple(
    (shift, scale) for shift in (0.0, 0.4, 0.9, 1.5, 2.2) for scale in (1.1, 1.4, 1.8, 2.4) if scale > 0.8 + 0.5 * shift
)


@dataclass(frozen=True)
class Placement:
    """An assumption about the whole silhouette: its centroid and radius of gyration in pixels."""

    center_px: Float
    gyration_px: float

    @classmethod
    def of(cls, moments: Moments) -> Placement:
        """What an image shows is the whole silhouette."""
        return cls(moments.center_px, moments.gyration_px)


@dataclass(frozen=True)
class ShapeMatches:
    """Coarse poses, best first: T_cam_target (N, 4, 4), view index (N,), shape score (N,) in 0..1."""

    T_cam_target: Float
    view: NDArray[np.intp]
    score: Float


def whole_placement(mask: Bool) -> list[Placement]:
    """The mask taken as the whole silhouette."""
    return [Placement.of(mask_moments(mask))]


def cut_placements(mask: Bool) -> list[Placement]:
    """The mask continues beyond the image border: centroids further out, larger sizes."""
    moments = mask_moments(mask)
    center, gyration = moments.center_px, moments.gyration_px
    outward = np.zeros(2)
    for pixels, direction in (
        (mask[0], (0, -1)),
        (mask[-1], (0, 1)),
        (mask[:, 0], (-1, 0)),
        (mask[:, -1], (1, 0)),
    ):
        outward += np.count_nonzero(pixels) * np.array(direction, dtype=np.float64)
    length = np.linalg.norm(outward)
    outward = outward / length if length > 0 else outward
    return [Placement(center + shift * gyration * outward, scale * gyration) for shift, scale in _CUT_ASSUMPTIONS]


def partial_placements(mask: Bool) -> list[Placement]:
    """Parts of the target are missing from the mask on an unknown side."""
    moments = mask_moments(mask)
    center, gyration = moments.center_px, moments.gyration_px
    angles = np.arange(8) * (np.pi / 4)
    return [Placement(center, 1.3 * gyration)] + [
        Placement(center + shift * gyration * np.array([np.cos(a), np.sin(a)]), scale * gyration)
        for shift, scale in ((0.5, 1.25), (0.9, 1.6))
        for a in angles
    ]


def match_shape(
    bank: ViewBank,
    mask: Bool,
    placements: list[Placement],
    camera: Camera,
    n_best: int,
    separation_deg: float,
    center_m: Float,
) -> ShapeMatches:
    """The best matches whose orientations differ by at least ``separation_deg``.

    Args:
        bank: the target's views.
        mask: (H, W) bool, without thin parts if the views are.
        placements: assumptions about centre and size, at least one.
        camera: intrinsics of the image.
        n_best: at most this many.
        separation_deg: smallest angle between two of them.
        center_m: (3,) centre of the target's box, which the bank's camera looks at.
    """
    score = _scores(bank, mask, placements)
    return _best_matches(bank, score, placements, camera, n_best, separation_deg, center_m)


def match_light(
    bank: ViewBank,
    light: Float32,
    camera: Camera,
    n_best: int,
    separation_deg: float,
    center_m: Float,
) -> ShapeMatches:
    """Correlation with a bank of brightness: the best distinct matches.

    Args:
        bank: the target's views, each spectrum of unit norm.
        light: (H, W) float32 of any scale, black but for the target, not all black.
        camera, n_best, separation_deg, center_m: as for :func:`match_shape`.
    """
    light = subdued(light)
    placement = Placement.of(image_moments(light))
    grid = polar_grid(light, placement.center_px, placement.gyration_px, bank.n_angles)
    norm = float(np.linalg.norm(grid))
    score = _correlate(bank, grid[None] / np.float32(norm if norm > 0 else 1.0))
    return _best_matches(bank, score, [placement], camera, n_best, separation_deg, center_m)


def _best_matches(
    bank: ViewBank,
    score: Float32,
    placements: list[Placement],
    camera: Camera,
    n_best: int,
    separation_deg: float,
    center_m: Float,
) -> ShapeMatches:
    """The best of all scores (placements, views, angles) that are distinct."""
    peaks = _peaks(score)
    best = score.ravel()[peaks]
    for n_sorted in (min(len(peaks), count) for count in _SORTED_COUNTS):
        order = np.argpartition(-best, n_sorted - 1)[:n_sorted]
        order = order[np.lexsort((order, -best[order]))]
        placement, view, angle = np.unravel_index(peaks[order], score.shape)
        angle_rad = angle.astype(np.float64) * (2.0 * np.pi / bank.n_angles)
        T = _poses(bank, placements, placement, view, angle_rad, camera, center_m)
        keep = distinct(T[:, :3, :3], n_best, np.radians(separation_deg))
        if len(keep) == n_best:
            break
    return ShapeMatches(T[keep], view[keep], best[order][keep].astype(np.float64))


def distinct(R: Float, n_best: int, separation_rad: float) -> NDArray[np.intp]:
    """Indices of rotations (N, 3, 3), in order, each at least so far from all before it."""
    quats = lie.quat_from_matrix(R)
    limit = np.cos(0.5 * separation_rad)
    free = np.ones(len(quats), dtype=bool)
    keep: list[int] = []
    for i in range(len(quats)):
        if free[i]:
            keep.append(i)
            if len(keep) == n_best:
                break
            free &= np.abs(quats @ quats[i]) < limit
    return np.array(keep, dtype=np.intp)


def _scores(bank: ViewBank, mask: Bool, placements: list[Placement]) -> Float32:
    """Tversky overlap (placements, views, angles) between mask and view, over what lies inside the image."""
    sampler, n_angles = PolarSampler(mask.astype(np.float32)), bank.n_angles
    grids = np.stack([sampler.grid(p.center_px, p.gyration_px, n_angles) for p in placements])
    overlap = _correlate(bank, grids)
    # Both grids carry the root of the sample's area; that of a mask against ones carries it once more.
    mask_area = (grids @ ring_weights()).sum(axis=1)[:, None, None]
    silhouette = np.broadcast_to(bank.area[None, :, None], overlap.shape)
    beyond = [i for i, p in enumerate(placements) if not _is_inside(p, mask.shape)]
    if beyond:
        cut = (placements[i] for i in beyond)
        inside = np.stack([border_grid(mask.shape, p.center_px, p.gyration_px, n_angles) for p in cut])
        silhouette = silhouette.copy()
        silhouette[beyond] = _correlate(bank, inside)
    union = silhouette - overlap
    union *= np.float32(MISSING_WEIGHT)
    union += mask_area  # which is overlap + (mask_area - overlap)
    overlap /= np.maximum(union, np.float32(1e-6), out=union)
    return overlap


def _is_inside(placement: Placement, shape: tuple[int, ...]) -> bool:
    """Whether the whole polar grid about a placement lies inside an image (H, W)."""
    reach = MAX_RADIUS * placement.gyration_px
    low, high = placement.center_px - reach, placement.center_px + reach
    return bool(low.min() >= 0 and high[0] <= shape[1] - 1 and high[1] <= shape[0] - 1)


def warm_up(bank: ViewBank) -> None:
    """Match an empty image with a bank, so that everything is compiled before the first frame."""
    _peaks(_correlate(bank, np.zeros((1, bank.n_angles, N_RINGS), np.float32)))


@njit(cache=True, nogil=True)
def _peaks(score: Float32) -> NDArray[np.intp]:
    """Flat indices of the scores (P, V, angles) that no neighbouring angle of the same view exceeds."""
    n_placements, n_views, n_angles = score.shape
    out, count = np.empty(score.size, np.intp), 0
    for p in range(n_placements):
        for v in range(n_views):
            for a in range(n_angles):
                s = score[p, v, a]
                if s >= score[p, v, a - 1] and s >= score[p, v, a + 1 - n_angles]:
                    out[count] = (p * n_views + v) * n_angles + a
                    count += 1
    return out[:count]


def _correlate(bank: ViewBank, grids: Float32) -> Float32:
    """Inner products of grids (P, angles, rings) with every view turned by every angle: (P, V, angles)."""
    spectrum = np.fft.rfft(grids, axis=1).astype(np.complex64).transpose(1, 0, 2)  # (F, P, rings)
    real, imag = np.ascontiguousarray(spectrum.real), np.ascontiguousarray(spectrum.imag)
    product = _cross_spectrum(np.asarray(bank.spectrum), real, imag)
    return np.fft.irfft(product, n=bank.n_angles, axis=2).astype(np.float32)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _cross_spectrum(views: NDArray[np.complex64], real: Float32, imag: Float32) -> NDArray[np.complex64]:
    """Sum over rings of ``conj(views) * query``: (F, V, rings), twice (F, P, rings) -> (P, V, F).

    Compiled rather than left to BLAS: many small products, whose threads cost more than they save. The sums may be
    taken in any order, or they could not be vectorised, which is ten times slower.
    """
    n_frequencies, n_views, n_rings = views.shape
    n_queries = real.shape[1]
    out = np.empty((n_queries, n_views, n_frequencies), np.complex64)
    for f in range(n_frequencies):
        for p in range(n_queries):
            x, y = real[f, p], imag[f, p]
            for v in range(n_views):
                sum_real, sum_imag = np.float32(0.0), np.float32(0.0)
                for r in range(n_rings):
                    a, b = views[f, v, r].real, views[f, v, r].imag
                    sum_real += a * x[r] + b * y[r]
                    sum_imag += a * y[r] - b * x[r]
                out[p, v, f] = complex(sum_real, sum_imag)
    return out


def _poses(
    bank: ViewBank,
    placements: list[Placement],
    placement: NDArray[np.intp],
    view: NDArray[np.intp],
    angle_rad: Float,
    camera: Camera,
    center_m: Float,
) -> Float:
    """Poses that put each view's silhouette, turned by its angle, on its placement: (N, 4, 4)."""
    K = camera.K
    focal = np.sqrt(K[0, 0] * K[1, 1])
    gyration = np.array([p.gyration_px for p in placements])[placement] / focal
    center = np.array([p.center_px for p in placements])[placement]
    scale = gyration / bank.gyration[view]
    depth = bank.distance_m / scale
    zeros, ones = np.zeros(len(view)), np.ones(len(view))
    roll = lie.so3_exp(np.stack([zeros, zeros, angle_rad], axis=1))
    offset = np.einsum("nij,nj->ni", roll[:, :2, :2], bank.centroid[view]) * scale[:, None]
    y = (center[:, 1] - K[1, 2]) / K[1, 1] - offset[:, 1]
    x = (center[:, 0] - K[0, 2] - K[0, 1] * (center[:, 1] - K[1, 2]) / K[1, 1]) / K[0, 0] - offset[:, 0]
    ray = np.stack([x, y, ones], axis=1)
    # The bank's camera looks straight at the target: turn it from the optical axis to the ray.
    axis = np.stack([-y, x, zeros], axis=1)
    sine = np.linalg.norm(axis, axis=1)
    turn = axis * (np.arctan(sine) / np.where(sine > 1e-12, sine, 1.0))[:, None]
    R = lie.so3_exp(turn) @ roll @ bank.R_cam_target[view]
    # Depth is measured along the ray, as the bank's distance is.
    position = ray / np.linalg.norm(ray, axis=1, keepdims=True) * depth[:, None]
    return lie.transform(R, position - R @ center_m)
