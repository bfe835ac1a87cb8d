"""A spacecraft that is not quite its CAD model: turned panels, other colours, missing parts.

Acts on the connected parts of any model, so that no part needs a name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hat_ros.array_types import Bool, Float, Int32, UInt8
from hat_ros.errors import UsageError
from hat_ros.geometry import lie
from hat_ros.target.model import Surface, Target
from hat_ros.target.srgb import linear_from_srgb, srgb_from_linear

# A part is a panel when it is this thin for its width and carries this share of the model's surface.
_PANEL_THINNESS = 0.12
_PANEL_AREA_SHARE = 0.02


@dataclass(frozen=True)
class Mismatch:
    """How the true spacecraft differs from the CAD model.

    Attributes:
        panel_turn_deg: flat parts turned about the line from the model's centre through theirs.
        recolor: 0 = as the CAD says; 1 = every texture and part multiplied by gains between 0.3 and 1.7 per channel.
        missing: share of the parts left out, smallest first.
        seed: of the colours.
    """

    panel_turn_deg: float = 0.0
    recolor: float = 0.0
    missing: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (0 <= self.recolor <= 1 and 0 <= self.missing < 1):
            raise UsageError(
                f"mismatch: recolor must be 0 to 1 and missing 0 to below 1, found {self.recolor} and {self.missing}"
            )


def apply_mismatch(target: Target, mismatch: Mismatch) -> Target:
    """The spacecraft as it is, in the frame of the CAD model."""
    part = _parts(target)
    part_area = np.bincount(part, target.face_areas_m2).astype(np.float64, copy=False)
    if mismatch.panel_turn_deg:
        target = _turn_panels(target, part, part_area, np.radians(mismatch.panel_turn_deg))
    if mismatch.recolor:
        target = _recolor(target, part, mismatch)
    if mismatch.missing:
        dropped = np.argsort(part_area, kind="stable")[: int(mismatch.missing * len(part_area))]
        target = _select(target, ~np.isin(part, dropped))
    return target


def _parts(target: Target) -> Int32:
    """(F,) number of the connected part of each face."""
    a, b = target.faces.ravel(), np.roll(target.faces, 1, axis=1).ravel()
    n = len(target.vertices_m)
    labels = connected_components(coo_matrix((np.ones(len(a), bool), (a, b)), (n, n)), directed=False)[1]
    return labels[target.faces[:, 0]]


def _turn_panels(target: Target, part: Int32, part_area: Float, angle: float) -> Target:
    vertices = target.vertices_m.copy()
    normals = target.surface.corner_normal.copy()
    for number in np.flatnonzero(part_area > _PANEL_AREA_SHARE * part_area.sum()):
        mine = part == number
        index = np.unique(target.faces[mine])
        points = target.vertices_m[index]
        center = 0.5 * (points.min(axis=0) + points.max(axis=0))
        axes = np.linalg.svd(points - center, full_matrices=False)[2]  # the last one is the panel's normal
        extents = np.ptp((points - center) @ axes.T, axis=0)
        arm = center - target.center_m
        length = np.linalg.norm(arm)
        # Plates that lie on the body have it along their normal; a wing holds it in its plane.
        if extents[2] > _PANEL_THINNESS * extents[1] or abs(axes[2] @ arm) > 0.3 * length or length == 0:
            continue
        R = lie.so3_exp(angle * arm / length)
        vertices[index] = (points - center) @ R.T + center
        normals[mine] = normals[mine] @ R.T.astype(np.float32)
    return replace(target, vertices_m=vertices, surface=replace(target.surface, corner_normal=normals))


def _recolor(target: Target, part: Int32, mismatch: Mismatch) -> Target:
    rng = np.random.default_rng([mismatch.seed, 5])
    surface = target.surface
    part_gain = 1 + 0.7 * mismatch.recolor * rng.uniform(-1, 1, (part.max() + 1, 3))
    texture_gain = 1 + 0.7 * mismatch.recolor * rng.uniform(-1, 1, (len(surface.textures) + 1, 3))
    gain = np.where(surface.texture_id[:, None] >= 0, texture_gain[surface.texture_id], part_gain[part])
    corner_rgb = surface.corner_rgb
    if corner_rgb is not None:
        corner_rgb = _scaled(corner_rgb, part_gain[part][:, None])
    textures = tuple(_scaled(image, factor) for image, factor in zip(surface.textures, texture_gain, strict=False))
    return replace(
        target,
        face_rgb=_scaled(target.face_rgb, gain),
        surface=replace(surface, textures=textures, corner_rgb=corner_rgb),
    )


def _scaled(rgb: UInt8, gain: Float) -> UInt8:
    return srgb_from_linear(linear_from_srgb(rgb) * gain)


def _select(target: Target, keep: Bool) -> Target:
    used, faces = np.unique(target.faces[keep], return_inverse=True)
    s = target.surface
    surface = Surface(
        s.corner_uv[keep],
        None if s.corner_rgb is None else s.corner_rgb[keep],
        s.corner_normal[keep],
        s.texture_id[keep],
        s.textures,
        s.roughness[keep],
        s.metallic[keep],
    )
    return replace(
        target,
        vertices_m=target.vertices_m[used],
        faces=faces.reshape(-1, 3).astype(np.int32),
        face_rgb=target.face_rgb[keep],
        surface=surface,
    )
