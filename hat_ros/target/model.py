"""The target's CAD model: metric triangles, their colours, and nothing that depends on a file format.

Poses ``T_cam_target`` refer to exactly the frame of these coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist

from hat_ros.array_types import Float, Float32, Int32, UInt8
from hat_ros.geometry.symmetry import Symmetry


@dataclass(frozen=True, eq=False)
class Surface:
    """How the faces look: textures with per-corner coordinates, and gloss; kept apart from the geometry.

    Attributes:
        corner_uv: (F, 3, 2) float32 texture coordinates of the corners, glTF sense (v up), zero without texture.
        corner_rgb: (F, 3, 3) uint8 vertex colours (sRGB), or None when no part has any.
        corner_normal: (F, 3, 3) float32 unit shading normals of the file in the target frame; the face's own where a
            part of the file has none.
        texture_id: (F,) int16 index into ``textures``, -1 = the face's own colour.
        textures: (h, w, 3) uint8 images, sRGB, colour factors already applied.
        roughness: (F,) float32, 0 mirror to 1 matt.
        metallic: (F,) float32, 0 dielectric to 1 metal.
    """

    corner_uv: Float32
    corner_rgb: UInt8 | None
    corner_normal: Float32
    texture_id: NDArray[np.int16]
    textures: tuple[UInt8, ...]
    roughness: Float32
    metallic: Float32

    def sample(self, face_id: Int32, barycentric: NDArray[np.floating], face_rgb: UInt8) -> UInt8:
        """Albedo (N, 3) uint8 sRGB at points on faces: (N,) face, (N, 3) barycentric weights of its corners."""
        rgb = face_rgb[face_id]
        weights = np.asarray(barycentric, dtype=np.float32)
        if self.corner_rgb is not None:
            rgb = np.rint(np.einsum("nk,nkc->nc", weights, self.corner_rgb[face_id].astype(np.float32))).astype(
                np.uint8
            )
        texture_id = self.texture_id[face_id]
        for index, texture in enumerate(self.textures):
            pick = np.flatnonzero(texture_id == index)
            if not pick.size:
                continue
            uv = np.einsum("nk,nkc->nc", weights[pick], self.corner_uv[face_id[pick]])
            height, width = texture.shape[:2]
            u = np.floor((uv[:, 0] % 1.0) * width).astype(np.int64) % width
            v = np.floor(((1.0 - uv[:, 1]) % 1.0) * height).astype(np.int64) % height
            rgb[pick] = texture[v, u]
        return rgb


@dataclass(frozen=True, eq=False)
class Target:
    """A metric CAD model.

    Attributes:
        name: stem of the file, for people.
        vertices_m: (V, 3) float64, coincident vertices merged, all of them used.
        faces: (F, 3) int32, none of zero area.
        face_rgb: (F, 3) uint8 mean sRGB colour of each face, grey (160) when the file has no colours.
        surface: textures and gloss, for rendering.
        sha256: hexadecimal digest of geometry and colours as loaded (unit scale included), the key of caches.
        declared_symmetry: what ``target.yaml`` or a data set declares; None = it is found from the model.
    """

    name: str
    vertices_m: Float
    faces: Int32
    face_rgb: UInt8
    surface: Surface
    sha256: str
    declared_symmetry: Symmetry | None = None

    @cached_property
    def center_m(self) -> Float:
        """(3,) centre of the axis-aligned box."""
        return 0.5 * (self.vertices_m.min(axis=0) + self.vertices_m.max(axis=0))

    @cached_property
    def bounding_radius_m(self) -> float:
        """Radius of the sphere about :attr:`center_m` that holds the model."""
        return float(np.linalg.norm(self.vertices_m - self.center_m, axis=1).max())

    @property
    def corners_m(self) -> Float:
        """(F, 3, 3) corners of the faces."""
        return self.vertices_m[self.faces]

    @cached_property
    def face_normals(self) -> Float:
        """(F, 3) unit normals, on the side from which the corners run counter-clockwise."""
        normals = area_vectors(self.corners_m)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    @cached_property
    def face_areas_m2(self) -> Float:
        """(F,) area of each face."""
        return triangle_areas(self.corners_m)

    @cached_property
    def hull_m(self) -> Float:
        """(H, 3) vertices of the convex hull: they decide how far the target extends in any direction."""
        try:
            return self.vertices_m[ConvexHull(self.vertices_m).vertices]
        except QhullError:  # a flat model has no hull of its own
            return self.vertices_m

    @cached_property
    def diameter_m(self) -> float:
        """Largest distance between two vertices."""
        points = self.hull_m
        return max(float(cdist(points[i : i + 512], points).max()) for i in range(0, len(points), 512))


def area_vectors(corners: Float) -> Float:
    """Normals (F, 3) of triangles (F, 3, 3), twice as long as their areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def triangle_areas(corners: Float) -> Float:
    """Areas (F,) of triangles (F, 3, 3)."""
    return 0.5 * np.linalg.norm(area_vectors(corners), axis=1)
