"""Spacecraft that no one designed: drawn by seed, so that the gate does not rest on the package's own models alone."""

from __future__ import annotations

import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial

from hat_ros.array_types import Float
from hat_ros.target.loading import target_from_scene
from hat_ros.target.model import Target

# sRGB: foil, white paint, grey paint, black paint, red and green markings.
_COLOURS = ((214, 166, 80), (226, 226, 220), (128, 130, 134), (40, 40, 44), (168, 50, 40), (60, 120, 80))
_CELLS = ((24, 32, 84), (34, 40, 98), (20, 28, 66))


def random_craft(seed: int) -> Target:
    """A body with equipment boxes, panels of solar cells, a dish and booms, 2 to 5 m long, coloured.

    Args:
        seed: the same seed gives the same craft.
    """
    rng = np.random.default_rng([seed, 11])
    scene = trimesh.Scene()
    size = rng.uniform(0.6, 1.4, 3)
    if rng.random() < 0.6:
        _add(scene, "body", trimesh.creation.box(size), rng.choice(_COLOURS[:3]))
    else:
        size[1] = size[0]
        _add(scene, "body", trimesh.creation.cylinder(0.5 * size[0], size[2], sections=24), rng.choice(_COLOURS[:3]))
    for number in range(rng.integers(3, 7)):
        box = trimesh.creation.box(size * rng.uniform(0.15, 0.45, 3))
        side = _direction(rng)
        box.apply_translation(0.5 * size * side / np.abs(side).max())
        _add(scene, f"box{number}", box, rng.choice(_COLOURS))
    for number in range(rng.integers(1, 4)):
        _add_panel(scene, f"panel{number}", rng, size)
    dish = trimesh.creation.revolve(np.array([(0, 0), (0.16, 0.02), (0.3, 0.09), (0.4, 0.18)]), sections=24)
    dish.apply_scale(rng.uniform(0.6, 1.6))
    _add(scene, "dish", _outward(dish, _direction(rng), size), _COLOURS[1])
    for number in range(rng.integers(0, 3)):
        length = rng.uniform(0.5, 1.6)
        boom = trimesh.creation.cylinder(0.025, length, sections=8)
        head = trimesh.creation.icosphere(1, 0.08)
        boom.apply_translation((0, 0, 0.5 * length))
        head.apply_translation((0, 0, length))
        to = _direction(rng)
        _add(scene, f"boom{number}", _outward(boom, to, size), _COLOURS[2])
        _add(scene, f"head{number}", _outward(head, to, size), rng.choice(_COLOURS))
    return target_from_scene(scene, f"random{seed}")


def _add_panel(scene: trimesh.Scene, name: str, rng: np.random.Generator, size: Float) -> None:
    """A panel of strips of cells on a yoke, sideways from the body, turned about its arm."""
    length, width, strips = rng.uniform(0.7, 2.2), rng.uniform(0.4, 0.9), int(rng.integers(3, 7))
    angle = rng.uniform(0, 2 * np.pi)
    to, turn = np.array([np.cos(angle), np.sin(angle), 0.0]), rng.uniform(0, np.pi)
    for strip in range(strips):
        part = trimesh.creation.box((width, 0.02, 0.94 * length / strips))
        part.apply_translation((0, 0, 0.2 + (strip + 0.5) * length / strips))
        part.apply_transform(trimesh.transformations.rotation_matrix(turn, (0, 0, 1)))
        _add(scene, f"{name}_{strip}", _outward(part, to, size), rng.choice(_CELLS))
    yoke = trimesh.creation.box((0.04, 0.04, 0.2 + length))
    yoke.apply_translation((0, 0, 0.5 * (0.2 + length)))
    _add(scene, f"{name}_yoke", _outward(yoke, to, size), _COLOURS[2])


def _outward(part: trimesh.Trimesh, to: Float, size: Float) -> trimesh.Trimesh:
    """A part modelled along +z from the origin, moved to the body's surface and turned into a direction."""
    part.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), to))
    part.apply_translation(0.5 * size * to / np.abs(to).max() * 0.95)
    return part


def _direction(rng: np.random.Generator) -> Float:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def _add(scene: trimesh.Scene, name: str, mesh: trimesh.Trimesh, rgb: tuple[int, int, int] | np.ndarray) -> None:
    flat = trimesh.Trimesh(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False)
    linear = [round(255 * (value / 255) ** 2.2) for value in rgb]  # glTF factors are linear
    material = PBRMaterial(name=name, baseColorFactor=[*linear, 255], roughnessFactor=0.5, metallicFactor=0.0)
    flat.visual = trimesh.visual.texture.TextureVisuals(material=material)
    scene.add_geometry(flat, node_name=name, geom_name=name)
