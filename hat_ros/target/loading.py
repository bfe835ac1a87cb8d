"""Reading CAD models: from a mesh file or a ``target.yaml`` to a :class:`hat_ros.target.model.Target`.

The coordinates are the file's own, with the transforms of its scene graph applied and no change of axes: a glTF stays
y-up if it was modelled so. Only a ``T_label_cad`` in its ``target.yaml`` turns and shifts it.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from hat_ros.array_types import Bool, Float, Float32, Int, Int32, UInt8
from hat_ros.errors import MeshError
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry
from hat_ros.target.companions import say_once
from hat_ros.target.mesh_file import read_scene, read_target_yaml
from hat_ros.target.model import Surface, Target, area_vectors, triangle_areas
from hat_ros.target.simplify import MAX_WORK_FACES, simplify
from hat_ros.target.srgb import linear_from_srgb, srgb_from_linear
from hat_ros.target.units import guess_unit_scale, warn_of_size

MAX_TEXTURE_SIDE_PX = 2048
MAX_SOURCE_TEXTURE_PX = 64 * 2**20
EXTENT_RANGE_M = (1e-3, 1e3)

_GREY = 160
# Barycentric sample points for the mean colour of a face: centroids of a regular 4 x 4 subdivision.
_FACE_SAMPLES = np.array(
    [((3 * i + 1) / 12, (3 * j + 1) / 12, (10 - 3 * i - 3 * j) / 12) for i in range(4) for j in range(4 - i)]
    + [((3 * i + 2) / 12, (3 * j + 2) / 12, (8 - 3 * i - 3 * j) / 12) for i in range(3) for j in range(3 - i)]
)


@dataclass(frozen=True)
class ModelFile:
    """A CAD file and what has to be known of it.

    Attributes:
        mesh: the file.
        unit_scale: metres per unit of the file.
        name: name of the target.
        symmetry: what is declared of it; None = nothing.
        T_label_cad: (4, 4) from the axes of the file, in metres, to the frame that poses refer to.
    """

    mesh: Path
    unit_scale: float
    name: str
    symmetry: Symmetry | None = None
    T_label_cad: Float = field(default_factory=lambda: np.eye(4))


def find_model(path: str | Path, unit_scale: float | None = 1.0) -> ModelFile:
    """The CAD file that a path names, itself or through a ``target.yaml``.

    ``target.yaml`` holds ``mesh`` (file beside it), ``unit_scale`` (metres per file unit, or ``auto``), ``name``, and
    ``T_label_cad`` where a data set's labels refer to other axes than the file's. It may declare symmetries as BOP
    does, in metres, about the axes that poses refer to: ``symmetries_discrete`` and ``symmetries_continuous``.

    Args:
        path: obj, ply, stl, glb or a ``target.yaml``.
        unit_scale: metres per unit of the file, multiplies the one of a ``target.yaml``; None = guessed from the size.

    Raises:
        MeshError: missing or malformed.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError(f"CAD model {path}: no such file")
    if path.suffix.lower() not in (".yaml", ".yml"):
        scale = guess_unit_scale(read_scene(path), path) if unit_scale is None else unit_scale
        return ModelFile(path, scale, path.stem)
    mesh, stated, name, symmetry, T_label_cad = read_target_yaml(path)
    scale = guess_unit_scale(read_scene(mesh), mesh) if stated is None or unit_scale is None else unit_scale * stated
    return ModelFile(mesh, scale, name, symmetry, T_label_cad)


def load_target(path: str | Path, unit_scale: float | None = 1.0) -> Target:
    """Read a CAD model (obj, ply, stl, glb) or a ``target.yaml`` that names one.

    Args:
        path: see :func:`find_model`.
        unit_scale: likewise.

    Raises:
        MeshError: unreadable, other format, empty, not finite, or of absurd size or extent.
    """
    model = find_model(path, unit_scale)
    target = target_from_scene(read_scene(model.mesh), model.name, model.unit_scale, model.T_label_cad)
    return replace(target, declared_symmetry=model.symmetry)


def target_from_scene(
    scene: trimesh.Scene, name: str, unit_scale: float = 1.0, T_label_cad: Float | None = None
) -> Target:
    """A target from a ``trimesh`` scene, its transforms applied, and last ``T_label_cad`` (4, 4), in metres.

    Raises:
        MeshError: no triangles, NaN, or absurd extents.
    """
    if not (np.isfinite(unit_scale) and unit_scale > 0):
        raise MeshError(f"CAD model {name}: unit_scale must be a positive number, found {unit_scale}")
    with np.errstate(over="ignore", invalid="ignore"):  # coordinates that overflow are refused below by their extent
        T_label_file = None
        if T_label_cad is not None and not np.array_equal(T_label_cad, np.eye(4)):
            T_label_file = lie.transform(T_label_cad[:3, :3], T_label_cad[:3, 3] / unit_scale)
        found = [_part(scene, node, name, T_label_file) for node in _ordered_nodes(scene)]
    parts = [part for part in found if part is not None]
    if not parts:
        raise MeshError(f"CAD model {name}: it holds no triangles; export the surface as a triangle mesh")
    if not any(part.has_color for part in parts):
        say_once(f"CAD model {name}: it has no colours and is taken as grey", logging.INFO)
    corners = np.concatenate([part.corners_m for part in parts]) * unit_scale
    _check_extent(corners, name, unit_scale)
    kept = np.ones(len(corners), bool)
    if len(corners) > MAX_WORK_FACES:
        corners, kept = _simplified(corners, name)
    # Exporters split vertices at texture seams, with rounding noise: merge what a millionth of the extent separates.
    origin, extent = corners.min(axis=(0, 1)), np.ptp(corners.reshape(-1, 3), axis=0).max()
    grid = np.rint((corners - origin) / (1e-6 * extent))
    keep = triangle_areas(grid) > 0
    if not keep.any():
        raise MeshError(f"CAD model {name}: every triangle has zero area")
    vertices, faces = _merged(corners, grid, keep)
    empty = triangle_areas(vertices[faces]) == 0
    if empty.any():  # corners in a line, which only the grid's rounding puts beside it
        keep[np.flatnonzero(keep)[empty]] = False
        if not keep.any():
            raise MeshError(f"CAD model {name}: every triangle has zero area")
        vertices, faces = _merged(corners, grid, keep)
    kept[kept] = keep
    surface, face_rgb = _surface(parts, kept)
    digest = hashlib.sha256()
    for array in (vertices, faces, face_rgb):
        digest.update(np.ascontiguousarray(array).tobytes())
    for array in (vertices, faces, face_rgb):
        array.setflags(write=False)
    return Target(name, vertices, faces, face_rgb, surface, digest.hexdigest())


def _ordered_nodes(scene: trimesh.Scene) -> list[str]:
    """Nodes with geometry, in the same order at every load.

    By geometry and transform: trimesh makes up random names for the nodes of a glTF mesh of several materials.
    """

    def key(node: str) -> tuple[str, bytes]:
        T, geometry_name = scene.graph[node]
        return str(geometry_name), np.asarray(T, dtype=np.float64).tobytes()

    return sorted(scene.graph.nodes_geometry, key=key)


def _merged(corners: Float, grid: Float, keep: Bool) -> tuple[Float, Int32]:
    """Vertices (V, 3) and faces (F, 3) of the kept triangles; corners at one place of the grid are one vertex."""
    _, first, index = np.unique(grid[keep].reshape(-1, 3), axis=0, return_index=True, return_inverse=True)
    return corners[keep].reshape(-1, 3)[first], index.reshape(-1, 3).astype(np.int32)


def _simplified(corners: Float, name: str) -> tuple[Float, Bool]:
    """Corners of fewer faces, and which of the faces they were."""
    fewer = simplify(corners)
    say_once(
        f"CAD model {name}: {len(corners)} triangles, simplified to {len(fewer.corners)} for the work; vertices move "
        f"by at most {np.sqrt(3) * fewer.cell:.2g} m",
        logging.INFO,
    )
    return fewer.corners, fewer.keep


@dataclass(frozen=True)
class _Part:
    corners_m: Float  # (F, 3, 3)
    corner_uv: Float32  # (F, 3, 2)
    corner_rgb: UInt8 | None  # (F, 3, 3)
    corner_normal: Float32  # (F, 3, 3)
    rgb: UInt8  # (F, 3)
    texture: UInt8 | None
    roughness: float
    metallic: float
    has_color: bool


def _part(scene: trimesh.Scene, node: str, name: str, T_label_file: Float | None) -> _Part | None:
    T_file_part, geometry_name = scene.graph[node]
    T = T_file_part if T_label_file is None else T_label_file @ T_file_part
    mesh = scene.geometry[geometry_name]
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        return None
    faces = np.asarray(mesh.faces)
    if faces.min() < 0 or faces.max() >= len(mesh.vertices):
        raise MeshError(f"CAD model {name}: part '{geometry_name}' has faces that refer to missing vertices")
    points = np.asarray(mesh.vertices, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f"CAD model {name}: some vertices have fewer than three coordinates; repair or export it again")
    # Infinite ones would spoil others in the product; only those that a face uses are an error.
    vertices = np.where(np.isfinite(points), points, np.nan) @ T[:3, :3].T + T[:3, 3]
    n_faces = len(faces)
    corner_uv = np.zeros((n_faces, 3, 2), np.float32)
    corner_rgb, texture, rgb = None, None, np.full((n_faces, 3), _GREY, np.uint8)
    roughness, metallic = 0.6, 0.0
    visual, has_color = mesh.visual, True
    if isinstance(visual, trimesh.visual.TextureVisuals) and not _is_placeholder(visual.material):
        rgb[:], texture, roughness, metallic = _material(visual.material)
        uv = None if visual.uv is None else np.asarray(visual.uv, dtype=np.float32)
        if uv is None or len(uv) != len(mesh.vertices) or not np.isfinite(uv).all():
            texture = None
        elif texture is not None:
            corner_uv = uv[faces]
    elif isinstance(visual, trimesh.visual.ColorVisuals) and visual.kind == "vertex":
        corner_rgb = np.asarray(visual.vertex_colors, dtype=np.uint8)[:, :3][faces]
    elif isinstance(visual, trimesh.visual.ColorVisuals) and visual.kind == "face":
        rgb = np.asarray(visual.face_colors, dtype=np.uint8)[:, :3].copy()
    else:
        has_color = False
    normal = _corner_normals(mesh, vertices[faces], faces, T[:3, :3])
    return _Part(vertices[faces], corner_uv, corner_rgb, normal, rgb, texture, roughness, metallic, has_color)


def _corner_normals(mesh: trimesh.Trimesh, corners: Float, faces: Int, linear: Float) -> Float32:
    """Unit (F, 3, 3) normals: the file's, or the faces' own where it brings none."""
    flat = area_vectors(corners)[:, None].repeat(3, axis=1)
    normal = flat
    # trimesh would compute vertex normals on demand; only those read from the file are in its cache at this point.
    if "vertex_normals" in mesh._cache:
        read = np.asarray(mesh.vertex_normals, dtype=np.float64)
        usable: Bool = np.asarray(np.isfinite(read).all(axis=-1, keepdims=True))
        own = np.where(usable, read, 0.0) @ np.linalg.pinv(linear)
        normal = np.where(usable[faces], own[faces], flat)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(length > 1e-12, normal, flat)
    return (normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-300)).astype(np.float32)


def _is_placeholder(material: Any) -> bool:
    """Whether ``trimesh`` made it up, with an image of one colour, for texture coordinates without a material."""
    if not isinstance(material, trimesh.visual.material.SimpleMaterial) or material.image is None:
        return False
    made_up = trimesh.visual.material.empty_material().image
    return material.image.size == made_up.size and material.image.tobytes() == made_up.tobytes()


def _material(material: Any) -> tuple[UInt8, UInt8 | None, float, float]:
    """Colour (3,) sRGB, texture or None, roughness and metallic of a trimesh material."""
    is_pbr = isinstance(material, trimesh.visual.material.PBRMaterial)
    if is_pbr:
        factor, image = material.baseColorFactor, material.baseColorTexture
        # What glTF leaves out is 1: matt metal.
        roughness = 1.0 if material.roughnessFactor is None else float(np.clip(material.roughnessFactor, 0.05, 1))
        metallic = 1.0 if material.metallicFactor is None else float(np.clip(material.metallicFactor, 0, 1))
    else:
        factor, image = getattr(material, "diffuse", None), getattr(material, "image", None)
        roughness, metallic = 0.6, 0.0
    factor = np.full(3, 255.0) if factor is None else np.asarray(factor, dtype=np.float64).reshape(-1)[:3]
    # glTF factors are linear, its textures and everything of OBJ are sRGB.
    color = srgb_from_linear(factor / 255.0) if is_pbr else np.rint(factor).astype(np.uint8)
    if image is None:
        return color, None, roughness, metallic
    if image.size[0] * image.size[1] > MAX_SOURCE_TEXTURE_PX:
        raise MeshError(
            f"CAD model: a texture of {image.size[0]}x{image.size[1]} px is larger than the accepted "
            f"{MAX_SOURCE_TEXTURE_PX // 2**20} megapixels; scale it down"
        )
    try:
        image = image.convert("RGB")
    except Exception as error:  # whatever the broken bytes lead the decoder to
        raise MeshError(
            f"CAD model: one of its textures cannot be decoded ({type(error).__name__}): export the model again"
        ) from None
    if max(image.size) > MAX_TEXTURE_SIDE_PX:
        image.thumbnail((MAX_TEXTURE_SIDE_PX, MAX_TEXTURE_SIDE_PX))
    texture = np.array(image, dtype=np.uint8)
    if is_pbr and factor.min() < 254.5:
        texture = srgb_from_linear(linear_from_srgb(texture) * (factor / 255.0))
    return color, texture, roughness, metallic


def _surface(parts: list[_Part], keep: Bool) -> tuple[Surface, UInt8]:
    counts = [len(part.rgb) for part in parts]
    textures: list[UInt8] = []
    texture_id = []
    for part, count in zip(parts, counts, strict=True):
        index = -1
        if part.texture is not None:
            index = next((i for i, other in enumerate(textures) if other is part.texture), len(textures))
            if index == len(textures):
                textures.append(part.texture)
        texture_id.append(np.full(count, index, np.int16))
    corner_rgb = None
    if any(part.corner_rgb is not None for part in parts):
        corner_rgb = np.concatenate(
            [np.repeat(p.rgb[:, None], 3, axis=1) if p.corner_rgb is None else p.corner_rgb for p in parts]
        )[keep]
    surface = Surface(
        np.concatenate([part.corner_uv for part in parts])[keep],
        corner_rgb,
        np.concatenate([part.corner_normal for part in parts])[keep],
        np.concatenate(texture_id)[keep],
        tuple(textures),
        np.repeat([part.roughness for part in parts], counts).astype(np.float32)[keep],
        np.repeat([part.metallic for part in parts], counts).astype(np.float32)[keep],
    )
    rgb = np.concatenate([part.rgb for part in parts])[keep]
    every = np.arange(len(rgb), dtype=np.int32)
    mean = np.zeros((len(rgb), 3), np.float64)
    for weights in _FACE_SAMPLES:
        mean += surface.sample(every, np.broadcast_to(weights, (len(rgb), 3)), rgb)
    return surface, np.rint(mean / len(_FACE_SAMPLES)).astype(np.uint8)


def _check_extent(corners: Float, name: str, unit_scale: float) -> None:
    if not np.isfinite(corners).all():
        raise MeshError(f"CAD model {name}: some vertex coordinates are not finite numbers; repair the file")
    extent = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    low, high = EXTENT_RANGE_M
    if not low <= extent <= high:
        raise MeshError(
            f"CAD model {name}: its largest extent is {extent:.3g} m with unit_scale {unit_scale:g}, expected "
            f"{low:g} to {high:g} m; set unit_scale to the metres per unit of the file (0.001 for millimetres)"
        )
    warn_of_size(extent, name, unit_scale)
