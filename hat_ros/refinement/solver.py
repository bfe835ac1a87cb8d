"""Gauss-Newton on contour points, compiled: mask distance for capture range, image profiles for sub-pixel accuracy.

A pose update is ``[dt (m); r (rad)]`` in the camera frame about the target's origin, ``X' = Exp(r) (X - t) + t + dt``,
the convention of ``Refined.covariance``. Residuals are pixels of the image, measured along the contour's normal.
Weights are Geman-McClure with a scale that the caller anneals (Geman and McClure, Bull. ISI 52, 1987).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hat_ros.array_types import Float, Float32, UInt8
from hat_ros.geometry.linear import cholesky_in_place, cholesky_solve, product, rotation

# Lines with less free target or background than this have no colour of their own to compare.
MIN_REACH_PX = 2.0
# Grey levels that noise and compression put on a line; contrast is judged against it.
NOISE_LEVEL = 4.0
# Scatter of a line about its step, in squared contrasts, at which an edge counts half.
SCATTER_REF = 0.04
# No residual's standard deviation is taken for less than a quarter of a pixel.
VARIANCE_FLOOR_PX2 = 0.0625
# Contour length over which residuals err together, one independent sample each: pixels, and a share of the outline,
# because shadows and misfits of the CAD model come in parts of the body.
CORRELATION_PX = 8.0
CORRELATION_SHARE = 0.03
# Errors common to a whole outline, one sigma in pixels: a mask drawn too large, an exposure that blooms. They are
# estimated along with the pose.
BIAS_PX = (1.0, 0.15)
# The two kinds of residuals; pose parameters, then a bias of each kind.
MASK, EDGE = 0, 1
N_PARAMETERS = 8


@njit(cache=True, nogil=True)
def _normal_row(
    x: float,
    y: float,
    z: float,
    tx: float,
    ty: float,
    tz: float,
    fx: float,
    fy: float,
    nu: float,
    nv: float,
    row: Float,
) -> None:
    """Derivative of the image position along (nu, nv) with respect to the pose update, into row (6,)."""
    gx = nu * fx / z
    gy = nv * fy / z
    gz = -(gx * x + gy * y) / z
    rx, ry, rz = x - tx, y - ty, z - tz
    row[0], row[1], row[2] = gx, gy, gz
    row[3] = ry * gz - rz * gy
    row[4] = rz * gx - rx * gz
    row[5] = rx * gy - ry * gx


@njit(cache=True, nogil=True)
def _accumulate(
    kind: int, H: Float, g: Float, squares: Float, weights: Float, row: Float, weight: float, residual: float
) -> None:
    """Add one weighted residual with derivative row to the normal equations of its kind (lower triangle)."""
    for i in range(len(row)):
        g[kind, i] -= weight * row[i] * residual
        for j in range(i + 1):
            H[kind, i, j] += weight * row[i] * row[j]
    squares[kind] += weight * residual * residual
    weights[kind] += weight


@njit(cache=True, nogil=True)
def _damped_step(H: Float, g: Float, damping: float, radius_m: float) -> tuple[bool, Float]:
    """Step of the pose and the biases; damping is a share of the mean translational information."""
    level = (H[0, 0] + H[1, 1] + H[2, 2]) / 3.0 * damping + 1e-12
    L = H.copy()
    for i in range(3):
        L[i, i] += level
        L[i + 3, i + 3] += level * radius_m * radius_m
    if not cholesky_in_place(L):
        return False, g
    return True, cholesky_solve(L, g)


@njit(cache=True, nogil=True)
def _mask_distance(distance: Float32, a: float, b: float, out: Float) -> None:
    """Bilinear signed distance and its gradient at crop position (a, b), into out (3,)."""
    h, w = distance.shape
    a, b = min(max(a, 0.0), w - 1.001), min(max(b, 0.0), h - 1.001)
    ia, ib = int(a), int(b)
    fa, fb = a - ia, b - ib
    d00, d10 = distance[ib, ia], distance[ib, ia + 1]
    d01, d11 = distance[ib + 1, ia], distance[ib + 1, ia + 1]
    out[0] = (d00 * (1 - fa) + d10 * fa) * (1 - fb) + (d01 * (1 - fa) + d11 * fa) * fb
    out[1] = (d10 - d00) * (1 - fb) + (d11 - d01) * fb
    out[2] = (d01 - d00) * (1 - fa) + (d11 - d10) * fa


@njit(cache=True, nogil=True)
def _sample(image: UInt8, u: float, v: float, out: Float) -> None:
    """Bilinear colour at (u, v), which must lie inside the image."""
    iu, iv = int(u), int(v)
    fu, fv = u - iu, v - iv
    for c in range(3):
        top = image[iv, iu, c] * (1 - fu) + image[iv, iu + 1, c] * fu
        bottom = image[iv + 1, iu, c] * (1 - fu) + image[iv + 1, iu + 1, c] * fu
        out[c] = top * (1 - fv) + bottom * fv


@njit(cache=True, nogil=True)
def edge_offset(
    image: UInt8,
    u: float,
    v: float,
    nu: float,
    nv: float,
    reach_in: float,
    reach_out: float,
    step: float,
    profile: Float,
    levels: Float,
) -> tuple[float, float]:
    """Where the image's own edge lies along an outward normal.

    The colours at both ends of the line are taken for target and background; the edge is the crossing of their half
    level nearest to the present contour.

    Returns:
        offset in pixels (positive outwards), and how much it counts, 0 (no edge) to 1: contrast against noise, and how
        much like a step the line looks.
    """
    n_in, n_out = int(reach_in / step), int(reach_out / step)
    n = n_in + n_out + 1
    h, w = image.shape[0], image.shape[1]
    for k in range(n):
        o = (k - n_in) * step
        pu, pv = u + o * nu, v + o * nv
        if pu < 0 or pv < 0 or pu >= w - 1 or pv >= h - 1:
            return 0.0, 0.0
        _sample(image, pu, pv, profile[k])
    contrast_sq = 0.0
    for c in range(3):
        diff = 0.5 * (profile[0, c] + profile[1, c] - profile[n - 1, c] - profile[n - 2, c])
        contrast_sq += diff * diff
    if contrast_sq < 1e-6:
        return 0.0, 0.0
    best, found = 1e9, False
    for k in range(n):
        level = 0.0
        for c in range(3):
            f = 0.5 * (profile[0, c] + profile[1, c])
            b = 0.5 * (profile[n - 1, c] + profile[n - 2, c])
            level += (profile[k, c] - b) * (f - b)
        levels[k] = level / contrast_sq
        if k > 0 and levels[k - 1] >= 0.5 > levels[k]:
            o = (k - 1 - n_in + (levels[k - 1] - 0.5) / (levels[k - 1] - levels[k])) * step
            if abs(o) < abs(best):
                best, found = o, True
    if not found:
        return 0.0, 0.0
    scatter, count = 0.0, 0
    for k in range(n):
        o = (k - n_in) * step - best
        if abs(o) > 1.0:  # the edge itself is blurred
            deviation = levels[k] - (1.0 if o < 0 else 0.0)
            scatter += deviation * deviation
            count += 1
    scatter = scatter / count if count > 0 else 0.0
    noise = 3.0 * NOISE_LEVEL * NOISE_LEVEL / contrast_sq
    return best, 1.0 / (1.0 + scatter / SCATTER_REF + noise)


@njit(cache=True, nogil=True)
def _add_residuals(
    points: Float, lines: Float, R: Float, t: Float, K: Float, image: UInt8, reach_px: float,
    distance: Float32, origin: Float, scales_px: Float, biases: Float,
    H: Float, g: Float, squares: Float, weights: Float, state: Float,
) -> None:  # fmt: skip
    """Normal equations of mask and edges at a pose, one after the other.

    Adds to H (2, 8, 8), g (2, 8) and to the weighted sums of squared residuals (2,) and of weights (2,); writes what is
    found of each point into state (N, 5). See :func:`fit_contour`.
    """
    row, mask_at = np.zeros(N_PARAMETERS), np.empty(3)
    profile, levels = np.empty((64, 3)), np.empty(64)
    mask_sq, edge_sq = scales_px[MASK] ** 2, scales_px[EDGE] ** 2
    spacing = max(reach_px / 8.0, 0.5)
    height, width = image.shape[0], image.shape[1]
    for i in range(len(points)):
        p = points[i]
        x = R[0, 0] * p[0] + R[0, 1] * p[1] + R[0, 2] * p[2] + t[0]
        y = R[1, 0] * p[0] + R[1, 1] * p[1] + R[1, 2] * p[2] + t[1]
        z = R[2, 0] * p[0] + R[2, 1] * p[1] + R[2, 2] * p[2] + t[2]
        if z <= 1e-6:
            continue
        u, v = (K[0, 0] * x + K[0, 1] * y) / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        if u < 1.0 or v < 1.0 or u > width - 2.0 or v > height - 2.0:
            continue
        state[i, 0] = 1.0
        if mask_sq > 0.0:
            _mask_distance(distance, u - origin[0], v - origin[1], mask_at)
            residual = mask_at[0] - biases[MASK]
            robust = (mask_sq / (mask_sq + residual * residual)) ** 2
            state[i, 1], state[i, 2] = mask_at[0], robust
            _normal_row(x, y, z, t[0], t[1], t[2], K[0, 0], K[1, 1], mask_at[1], mask_at[2], row)
            row[6 + MASK], row[6 + EDGE] = -1.0, 0.0
            _accumulate(MASK, H, g, squares, weights, row, lines[i, 2] * robust, residual)
        inside, outside = min(reach_px, lines[i, 3]), min(reach_px, lines[i, 4])
        if inside < MIN_REACH_PX or outside < MIN_REACH_PX:
            continue
        nu, nv = lines[i, 0], lines[i, 1]
        offset, quality = edge_offset(image, u, v, nu, nv, inside, outside, spacing, profile, levels)
        if quality <= 0.0:
            continue
        residual = -offset - biases[EDGE]
        robust = quality * (edge_sq / (edge_sq + residual * residual)) ** 2
        state[i, 3], state[i, 4] = offset, robust
        _normal_row(x, y, z, t[0], t[1], t[2], K[0, 0], K[1, 1], nu, nv, row)
        row[6 + MASK], row[6 + EDGE] = 0.0, -1.0
        _accumulate(EDGE, H, g, squares, weights, row, lines[i, 2] * robust, residual)


@njit(cache=True, nogil=True)
def _combine(
    H_each: Float, g_each: Float, squares: Float, weights: Float, biases: Float, correlation_px: float,
    H: Float, g: Float,
) -> None:  # fmt: skip
    """Both residuals by their measured variances, and what is known of the biases: into H (8, 8), lower triangle, g."""
    H[:], g[:] = 0.0, 0.0
    for kind in range(2):
        variance = squares[kind] / weights[kind] if weights[kind] > 0.0 else 0.0
        information = 1.0 / (max(variance, VARIANCE_FLOOR_PX2) * correlation_px)
        H += information * H_each[kind]
        g += information * g_each[kind]
    for kind in range(2):
        information = BIAS_PX[kind] ** -2.0
        H[6 + kind, 6 + kind] += information
        g[6 + kind] -= information * biases[kind]


@njit(cache=True, nogil=True)
def fit_contour(
    points: Float,
    lines: Float,
    R: Float,
    t: Float,
    K: Float,
    image: UInt8,
    reaches_px: Float,
    distance: Float32,
    origin: Float,
    mask_scales_px: Float,
    edge_scales_px: Float,
    dampings: Float,
    turned: Float,
    rotation_info: Float,
    radius_m: float,
) -> tuple[Float, Float, Float, Float, float, float]:
    """Fit contour points to a mask's boundary and to the image's own edges, each weighted by its measured variance.

    Args:
        points: (N, 3) contour points in the target frame, metres.
        lines: (N, 5) outward normal (2), contour length, free distance inwards and outwards; pixels.
        R, t: start pose.
        K: (3, 3) intrinsics of the whole image.
        image: (H, W, 3) uint8; its size bounds what counts.
        reaches_px: (I,) half length of the lines in each iteration, 0 = edges unused.
        distance: (h, w) float32 signed distance to the mask's boundary, positive outside.
        origin: (2,) image position of its pixel (0, 0).
        mask_scales_px: (I,) robust scale of the mask residuals in each iteration, 0 = mask unused.
        edge_scales_px: (I,) robust scale of the edge residuals.
        dampings: (I,) share of the mean information added in every direction, so that what cannot be observed stays.
        turned: (3,) rotation vector from the expected rotation to the start's.
        rotation_info: (3, 3) information about the expected rotation (1/rad^2), which holds what the contour says
            little about; zero = none.
        radius_m: bounding radius of the target, which makes rotations and translations commensurate.

    Returns:
        R, t, information (8, 8) of pose, mask bias and edge bias in the last iteration, before its step and without the
        prior, and per point (N, 5): in the image (0/1), mask distance, its robust weight, edge offset, its weight
        (0 = no edge found); mask bias and edge bias in pixels.
    """
    state, biases, turned = np.zeros((len(points), 5)), np.zeros(2), turned.copy()
    H_each, g_each = np.empty((2, N_PARAMETERS, N_PARAMETERS)), np.empty((2, N_PARAMETERS))
    squares, weights = np.empty(2), np.empty(2)
    H, g = np.zeros((N_PARAMETERS, N_PARAMETERS)), np.empty(N_PARAMETERS)
    correlation_px = CORRELATION_PX + CORRELATION_SHARE * lines[:, 2].sum()
    scales_px = np.empty(2)
    for iteration in range(len(reaches_px)):
        scales_px[MASK], scales_px[EDGE] = mask_scales_px[iteration], edge_scales_px[iteration]
        H_each[:], g_each[:], squares[:], weights[:], state[:] = 0.0, 0.0, 0.0, 0.0, 0.0
        _add_residuals(
            points, lines, R, t, K, image, reaches_px[iteration], distance, origin, scales_px, biases,
            H_each, g_each, squares, weights, state,
        )  # fmt: skip
        _combine(H_each, g_each, squares, weights, biases, correlation_px, H, g)
        A = H.copy()
        A[3:6, 3:6] += rotation_info
        for i in range(3):
            for j in range(3):
                g[i + 3] -= rotation_info[i, j] * turned[j]
        ok, step = _damped_step(A, g, dampings[iteration], radius_m)
        if not ok:
            break
        R, t = product(rotation(step[3:6]), R), t + step[:3]
        turned += step[3:6]
        biases += step[6:]
    return R, t, H, state, biases[MASK], biases[EDGE]
