"""Building blocks of spacecraft models: shapes, drawn textures, and how a part joins a scene."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image, ImageDraw
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from hat_ros.array_types import Float

# Side of the square of surface that one repeat of a texture covers.
TILE_M = 0.5


def plain(name: str, srgb: tuple[int, int, int], roughness: float) -> PBRMaterial:
    """One colour all over."""
    texture = Image.new("RGB", (4, 4), srgb)
    return PBRMaterial(name=name, baseColorTexture=texture, roughnessFactor=roughness, metallicFactor=0.0)


def solar_cells(rng: np.random.Generator) -> Image.Image:
    """Solar cells: 4 x 8 of them, each of its own blue, with silver grid lines."""
    image = Image.new("RGB", (128, 128), (150, 155, 165))
    draw = ImageDraw.Draw(image)
    for row in range(4):
        for col in range(8):
            blue = np.array([18, 26, 70]) + rng.integers(-6, 14, 3)
            draw.rectangle((col * 16 + 1, row * 32 + 1, col * 16 + 14, row * 32 + 30), fill=tuple(blue.tolist()))
    return image


def foil(rng: np.random.Generator) -> Image.Image:
    """Crinkled gold foil: patches of light and dark."""
    coarse = Image.fromarray(rng.integers(0, 256, (12, 12), dtype=np.uint8)).resize(
        (128, 128), Image.Resampling.BICUBIC
    )
    fine = Image.fromarray(rng.integers(0, 256, (32, 32), dtype=np.uint8)).resize((128, 128), Image.Resampling.BICUBIC)
    shade = 0.55 + 0.45 * (0.6 * np.asarray(coarse) + 0.4 * np.asarray(fine))[..., None] / 255.0
    return Image.fromarray(np.clip(shade * np.array([222, 168, 72]), 0, 255).astype(np.uint8))


def add(scene: trimesh.Scene, name: str, mesh: trimesh.Trimesh, material: PBRMaterial, tile_m: float = TILE_M) -> None:
    """Give every face flat texture coordinates (box mapping, one tile per ``tile_m``) and add it under a name."""
    corners = np.asarray(mesh.triangles)
    normals = np.abs(np.asarray(mesh.face_normals))
    axes = np.array([[1, 2], [0, 2], [0, 1]])[np.argmax(normals, axis=1)]
    uv = np.take_along_axis(corners, np.repeat(axes[:, None], 3, axis=1), axis=2) / tile_m
    flat = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    flat.visual = TextureVisuals(uv=uv.reshape(-1, 2), material=material)
    scene.add_geometry(flat, node_name=name, geom_name=name)


def box(size: tuple[float, ...], center: tuple[float, ...] = (0, 0, 0)) -> trimesh.Trimesh:
    """A box by its side lengths and centre."""
    return moved(trimesh.creation.box(size), center)


def turned(outline: list[tuple[float, float]], base: tuple[float, ...]) -> trimesh.Trimesh:
    """Body of revolution about z from (radius, height) points."""
    return moved(trimesh.creation.revolve(np.array(outline), sections=40), base)


def moved(mesh: trimesh.Trimesh, offset: tuple[float, ...] | Float) -> trimesh.Trimesh:
    """The mesh itself, shifted."""
    mesh.apply_translation(offset)
    return mesh
