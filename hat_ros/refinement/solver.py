"""Gauss-Newton on contour points, compiled: mask distance for capture range, image profiles for sub-pixel accuracy.

A pose update is ``[dt (m); r (rad)]`` in the camera frame about the target's origin, ``X' = Exp(r) (X - t) + t + dt``,
the convention of ``Refined.covariance``. Residuals are pixels of the image, measured along the contour's normal.
Weights are Geman-McClure with a scale that the caller anneals (Geman and McClure, Bull. ISI 52, 1987).
"""

from __future__ import annotations

import numpy as np
from numba import njit

# Lines with less free target or background than this have no colour of their own to compare.
MIN_REACH_PX = 2.0
# Contrast in grey levels at which an edge counts half.
CONTRAST_REF = 20.0
# Neither masks nor edges are trusted beyond a quarter of a pixel.
VARIANCE_FLOOR_PX2 = 0.0625
# Share of the mean information that is added in every direction.
DAMPING = 1e-3


@njit(cache=True)
def cholesky_solve(A, b):
    """Solve the symmetric positive definite system ``A x = b`` of any small size; False when A is not."""
    n = A.shape[0]
    L = np.zeros((n, n))
    x = np.zeros(n)
    for i in range(n):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if s <= 1e-300:
                    return False, x
                L[i, i] = np.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]
    return True, x


@njit(cache=True)
def rotation_exp(r):
    """(3, 3) rotation of a rotation vector (Rodrigues)."""
    angle_sq = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    if angle_sq < 1e-8:
        a, b = 1.0 - angle_sq / 6.0, 0.5 - angle_sq / 24.0
    else:
        angle = np.sqrt(angle_sq)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle_sq
    K = np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
    R = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            s = 0.0
            for k in range(3):
                s += K[i, k] * K[k, j]
            R[i, j] = a * K[i, j] + b * s
        R[i, i] += 1.0
    return R


@njit(cache=True)
def _update_pose(R, t, step):
    dR = rotation_exp(step[3:])
    out = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[i, j] += dR[i, k] * R[k, j]
    return out, t + step[:3]


@njit(cache=True)
def _normal_row(x, y, z, tx, ty, tz, fx, fy, nu, nv, row):
    """Derivative of the image position along (nu, nv) with respect to the pose update, into row (6,)."""
    gx = nu * fx / z
    gy = nv * fy / z
    gz = -(gx * x + gy * y) / z
    rx, ry, rz = x - tx, y - ty, z - tz
    row[0], row[1], row[2] = gx, gy, gz
    row[3] = ry * gz - rz * gy
    row[4] = rz * gx - rx * gz
    row[5] = rx * gy - ry * gx


@njit(cache=True)
def _accumulate(H, g, row, weight, residual):
    for i in range(6):
        g[i] -= weight * row[i] * residual
        for j in range(i + 1):
            H[i, j] += weight * row[i] * row[j]


@njit(cache=True)
def _damped_solve(H, g, damping_t, damping_r):
    A = np.empty((6, 6))
    for i in range(6):
        for j in range(i + 1):
            A[i, j] = H[i, j]
            A[j, i] = H[i, j]
    for i in range(3):
        A[i, i] += damping_t
        A[i + 3, i + 3] += damping_r
    return cholesky_solve(A, g)


@njit(cache=True)
def _mask_distance(distance, a, b, out):
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


@njit(cache=True)
def _sample(image, u, v, out):
    """Bilinear colour at (u, v), which must lie inside the image."""
    iu, iv = int(u), int(v)
    fu, fv = u - iu, v - iv
    for c in range(3):
        top = image[iv, iu, c] * (1 - fu) + image[iv, iu + 1, c] * fu
        bottom = image[iv + 1, iu, c] * (1 - fu) + image[iv + 1, iu + 1, c] * fu
        out[c] = top * (1 - fv) + bottom * fv


@njit(cache=True)
def edge_offset(image, u, v, nu, nv, reach_in, reach_out, step, profile):
    """Where the image's own edge lies along an outward normal.

    The colours at both ends of the line are taken for target and background; the edge is the crossing of their half
    level nearest to the present contour.

    Returns:
        offset in pixels (positive outwards), contrast in grey levels (root mean square over channels; 0 = no edge).
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
    previous = 0.0
    for k in range(n):
        level = 0.0
        for c in range(3):
            f = 0.5 * (profile[0, c] + profile[1, c])
            b = 0.5 * (profile[n - 1, c] + profile[n - 2, c])
            level += (profile[k, c] - b) * (f - b)
        level /= contrast_sq
        if k > 0 and previous >= 0.5 > level:
            o = (k - 1 - n_in + (previous - 0.5) / (previous - level)) * step
            if abs(o) < abs(best):
                best, found = o, True
        previous = level
    if not found:
        return 0.0, 0.0
    return best, np.sqrt(contrast_sq / 3.0)


@njit(cache=True)
def _mean_square(total, weight, floor):
    """Weighted mean square residual, not below floor."""
    return max(total / weight, floor) if weight > 0.0 else floor


@njit(cache=True)
def fit_contour(points, lines, R, t, K, image, reaches_px, distance, origin, mask_scales_px, edge_scales_px, radius_m):
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
        radius_m: bounding radius of the target, which makes rotations and translations commensurate.

    Returns:
        R, t, information H (6, 6) of the last iteration before its step (pixels of contour as independent samples),
        and per point (N, 5): in the image (0/1), mask distance, its robust weight, edge offset, its weight
        (0 where no edge was found).
    """
    n = len(points)
    row, mask_at, profile = np.empty(6), np.empty(3), np.empty((64, 3))
    state = np.zeros((n, 5))
    height, width = image.shape[0], image.shape[1]
    H = np.zeros((6, 6))
    for iteration in range(len(reaches_px)):
        mask_sq, edge_sq = mask_scales_px[iteration] ** 2, edge_scales_px[iteration] ** 2
        reach = reaches_px[iteration]
        spacing = max(reach / 8.0, 0.5)
        H_mask, g_mask, H_edge, g_edge = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6)), np.zeros(6)
        mask_sum, mask_weight, edge_sum, edge_weight = 0.0, 0.0, 0.0, 0.0
        state[:] = 0.0
        for i in range(n):
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
                residual = mask_at[0]
                robust = (mask_sq / (mask_sq + residual * residual)) ** 2
                weight = lines[i, 2] * robust
                state[i, 1], state[i, 2] = residual, robust
                _normal_row(x, y, z, t[0], t[1], t[2], K[0, 0], K[1, 1], mask_at[1], mask_at[2], row)
                _accumulate(H_mask, g_mask, row, weight, residual)
                mask_sum += weight * residual * residual
                mask_weight += weight
            inside, outside = min(reach, lines[i, 3]), min(reach, lines[i, 4])
            if inside < MIN_REACH_PX or outside < MIN_REACH_PX:
                continue
            nu, nv = lines[i, 0], lines[i, 1]
            offset, contrast = edge_offset(image, u, v, nu, nv, inside, outside, spacing, profile)
            if contrast <= 0.0:
                continue
            robust = (edge_sq / (edge_sq + offset * offset)) ** 2
            robust *= contrast * contrast / (contrast * contrast + CONTRAST_REF**2)
            weight = lines[i, 2] * robust
            state[i, 3], state[i, 4] = offset, robust
            _normal_row(x, y, z, t[0], t[1], t[2], K[0, 0], K[1, 1], nu, nv, row)
            _accumulate(H_edge, g_edge, row, weight, -offset)
            edge_sum += weight * offset * offset
            edge_weight += weight
        mask_info = 1.0 / _mean_square(mask_sum, mask_weight, VARIANCE_FLOOR_PX2)
        edge_info = 1.0 / _mean_square(edge_sum, edge_weight, VARIANCE_FLOOR_PX2)
        H = mask_info * H_mask + edge_info * H_edge
        g = mask_info * g_mask + edge_info * g_edge
        # A thousandth of the mean information keeps unobservable directions where they are.
        level = (H[0, 0] + H[1, 1] + H[2, 2]) / 3.0 * DAMPING + 1e-12
        ok, step = _damped_solve(H, g, level, level * radius_m * radius_m)
        if not ok:
            break
        R, t = _update_pose(R, t, step)
    return R, t, H, state
