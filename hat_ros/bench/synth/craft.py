"""Spacecraft that are drawn by seed: as many as training and a campaign need, all of our own making.

A bus (box, prism, drum, ball, or two of them stacked) carries equipment boxes, solar wings or body panels, dishes,
booms, a truss, nozzles and shields, in foils, paints and cells of random colour. Nothing is copied from a real craft.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from hat_ros.array_types import Float
from hat_ros.bench.synth.parts import add, box, foil, moved, plain, solar_cells, turned
from hat_ros.target.loading import target_from_scene
from hat_ros.target.model import Target

# sRGB of paints: white, grey, black, and the colours of markings and covers.
_PAINTS = ((226, 226, 220), (190, 192, 196), (128, 130, 134), (70, 72, 76), (34, 34, 38), (168, 50, 40), (60, 110, 80),
           (40, 70, 140), (196, 140, 60))  # fmt: skip
# What multiplies the colour of gold foil and of blue cells: gold, silver, copper, black; blue, black, violet, brown.
_FOILS = ((1.0, 1.0, 1.0), (0.95, 1.2, 2.6), (0.9, 0.75, 0.8), (0.25, 0.3, 0.6), (0.8, 0.9, 0.7))
_CELLS = ((1.0, 1.0, 1.0), (0.9, 0.9, 0.5), (1.6, 0.8, 1.0), (2.2, 1.5, 0.6), (0.6, 0.9, 1.4))

Materials = dict[str, PBRMaterial]


def generated_craft(seed: int) -> Target:
    """A spacecraft, some metres long.

    Args:
        seed: the same seed gives the same craft.
    """
    return target_from_scene(generated_scene(seed), f"generated{seed}")


def generated_scene(seed: int) -> trimesh.Scene:
    """The same as a scene, to be exported."""
    rng = np.random.default_rng([seed, 31])
    materials = _materials(rng)
    scene = trimesh.Scene()
    size = rng.uniform(0.5, 1.5, 3)
    if rng.random() < 0.3:
        size[2] *= rng.uniform(1.5, 2.5)  # a tall bus
    _add_bus(scene, rng, materials, size)
    for number in range(rng.integers(2, 9)):
        _add_equipment(scene, f"equipment{number}", rng, materials, size)
    for add_some, most in ((_add_wings, 2), (_add_dish, 2), (_add_boom, 4), (_add_truss, 1), (_add_nozzle, 3),
                           (_add_shield, 1)):  # fmt: skip
        count = int(rng.integers(0, most + 1))
        for number in range(max(count, 1) if add_some is _add_wings and rng.random() < 0.8 else count):
            add_some(scene, f"{add_some.__name__[5:]}{number}", rng, materials, size)
    return scene


def _materials(rng: np.random.Generator) -> Materials:
    """Those of one craft: two paints, a foil and cells, all of random colour, roughness and metal."""
    paints = rng.permutation(len(_PAINTS))[:3]
    materials = {
        f"paint{i}": plain(f"paint{i}", _PAINTS[paint], rng.uniform(0.3, 0.8)) for i, paint in enumerate(paints)
    }
    materials["foil"] = PBRMaterial(
        name="foil",
        baseColorTexture=_tinted(foil(rng), rng, _FOILS),
        roughnessFactor=rng.uniform(0.2, 0.5),
        metallicFactor=rng.uniform(0.0, 0.7),
    )
    materials["cells"] = PBRMaterial(
        name="cells",
        baseColorTexture=_tinted(solar_cells(rng), rng, _CELLS),
        roughnessFactor=rng.uniform(0.2, 0.5),
        metallicFactor=0.0,
    )
    return materials


def _tinted(image: Image.Image, rng: np.random.Generator, tints: Sequence[tuple[float, float, float]]) -> Image.Image:
    gain = np.array(tints[int(rng.integers(len(tints)))]) * rng.uniform(0.8, 1.2, 3)
    return Image.fromarray(np.clip(np.asarray(image) * gain, 0, 255).astype(np.uint8))


def _any(rng: np.random.Generator, materials: Materials, *names: str) -> PBRMaterial:
    """One of the named materials, or of all."""
    choice = names or tuple(materials)
    return materials[choice[rng.integers(len(choice))]]


def _add_bus(scene: trimesh.Scene, rng: np.random.Generator, materials: Materials, size: Float) -> None:
    kind = rng.choice(["box", "box", "prism", "drum", "ball", "stack"])
    material = _any(rng, materials, "foil", "foil", "paint0", "paint1", "cells")
    if kind in ("box", "stack"):
        add(scene, "bus", box(tuple(size)), material)
    if kind == "stack":
        upper = size * rng.uniform(0.4, 0.9, 3)
        add(scene, "upper", box(tuple(upper), (0, 0, 0.5 * (size[2] + upper[2]))), _any(rng, materials))
    if kind in ("prism", "drum"):
        size[1] = size[0]
        sections = int(rng.choice([5, 6, 8])) if kind == "prism" else 28
        drum = trimesh.creation.cylinder(0.5 * size[0], size[2], sections=sections)
        taper = rng.uniform(0.5, 1.0) if rng.random() < 0.4 else 1.0
        corners = drum.vertices.view(np.ndarray).copy()
        corners[:, :2] *= np.where(corners[:, 2:] > 0, taper, 1.0)
        add(scene, "bus", trimesh.Trimesh(corners, drum.faces), material)
    if kind == "ball":
        size[:] = size[0]
        add(scene, "bus", trimesh.creation.icosphere(2, 0.5 * size[0]), material)
    if rng.random() < 0.5:
        deck = box((1.04 * size[0], 1.04 * size[1], 0.05 * size[2]), (0, 0, rng.choice([-0.5, 0.5]) * size[2]))
        add(scene, "deck", deck, _any(rng, materials))


def _add_equipment(
    scene: trimesh.Scene, name: str, rng: np.random.Generator, materials: Materials, size: Float
) -> None:
    extent = size * rng.uniform(0.08, 0.45, 3)
    if rng.random() < 0.7:
        part = trimesh.creation.box(extent)
    else:
        part = trimesh.creation.cylinder(0.5 * extent[0], extent[2], sections=16)
    side = _direction(rng)
    at = 0.5 * size * side / np.abs(side).max()
    add(scene, name, moved(part, at), _any(rng, materials))


def _add_wings(scene: trimesh.Scene, name: str, rng: np.random.Generator, materials: Materials, size: Float) -> None:
    """One wing or, mostly, a pair: panels side by side on a yoke, turned about their arm."""
    length, width = rng.uniform(0.6, 3.0), rng.uniform(0.35, 1.2)
    panels, gap, yoke = int(rng.integers(1, 6)), rng.uniform(0.0, 0.05), rng.uniform(0.05, 0.5)
    angle, turn = rng.uniform(0, 2 * np.pi), rng.uniform(0, np.pi)
    to = np.array([np.cos(angle), np.sin(angle), rng.normal(0, 0.2)])
    material = _any(rng, materials, "cells", "cells", "cells", "paint0", "foil")
    back = _any(rng, materials)
    for side in (1, -1) if rng.random() < 0.75 else (1,):
        for panel in range(panels):
            pitch = length / panels
            at = yoke + (panel + 0.5) * pitch
            front = box((width, 0.015, pitch - gap), (0, 0.008, at))
            rear = box((width, 0.01, pitch - gap), (0, -0.006, at))
            for part, coat, face in ((front, material, "front"), (rear, back, "rear")):
                part.apply_transform(trimesh.transformations.rotation_matrix(turn, (0, 0, 1)))
                add(scene, f"{name}{side}{panel}{face}", _outward(part, side * to, size), coat)
        arm = box((0.04, 0.04, yoke + 0.9 * length), (0, 0, 0.5 * (yoke + 0.9 * length)))
        add(scene, f"{name}{side}arm", _outward(arm, side * to, size), materials["paint2"])


def _add_dish(scene: trimesh.Scene, name: str, rng: np.random.Generator, materials: Materials, size: Float) -> None:
    """A dish with its feed on three struts."""
    depth = rng.uniform(0.3, 1.0)
    outline = [(0.0, 0.0), (0.16, 0.02 * depth), (0.3, 0.09 * depth), (0.4, 0.2 * depth)]
    to, scale = _direction(rng), rng.uniform(0.4, 2.2)
    parts: list[tuple[str, trimesh.Trimesh, PBRMaterial]] = [
        ("dish", turned(outline, (0, 0, 0)), _any(rng, materials, "paint0", "paint1", "foil")),
        ("feed", moved(trimesh.creation.cylinder(0.04, 0.08, sections=12), (0, 0, 0.35)), materials["paint2"]),
    ]
    for leg in np.radians([90, 210, 330]):
        foot = (0.3 * np.cos(leg), 0.3 * np.sin(leg), 0.09 * depth)
        strut = trimesh.creation.cylinder(0.008, segment=[foot, (0, 0, 0.35)], sections=6)
        parts.append((f"strut{leg:.0f}", strut, materials["paint2"]))
    for part_name, part, material in parts:
        add(scene, f"{name}{part_name}", _outward(part.apply_scale(scale), to, size), material)


def _add_boom(scene: trimesh.Scene, name: str, rng: np.random.Generator, materials: Materials, size: Float) -> None:
    length, to, radius = rng.uniform(0.4, 3.0), _direction(rng), rng.uniform(0.008, 0.035)
    boom = moved(trimesh.creation.cylinder(radius, length, sections=8), (0, 0, 0.5 * length))
    add(scene, name, _outward(boom, to, size), _any(rng, materials, "paint0", "paint1", "paint2"))
    if rng.random() < 0.7:
        head = trimesh.creation.box(rng.uniform(0.06, 0.25, 3))
        add(scene, f"{name}head", _outward(moved(head, (0, 0, length)), to, size), _any(rng, materials))


def _add_truss(scene: trimesh.Scene, name: str, rng: np.random.Generator, materials: Materials, size: Float) -> None:
    """A mast of four longerons with diagonals."""
    length, side, to = rng.uniform(0.8, 2.5), rng.uniform(0.1, 0.25), _direction(rng)
    corners = 0.5 * side * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    bays = max(2, round(length / side))
    struts = [((*corner, 0.0), (*corner, length)) for corner in corners]
    for bay in range(bays):
        low, high = length * bay / bays, length * (bay + 1) / bays
        struts += [((*corners[i], low), (*corners[(i + 1) % 4], high)) for i in range(4)]
    coat = _any(rng, materials, "paint0", "paint1", "foil")
    for number, (foot, head) in enumerate(struts):
        strut = trimesh.creation.cylinder(0.012, segment=[np.array(foot), np.array(head)], sections=5)
        add(scene, f"{name}strut{number}", _outward(strut, to, size), coat)


def _add_nozzle(scene: trimesh.Scene, name: str, rng: np.random.Generator, materials: Materials, size: Float) -> None:
    throat = rng.uniform(0.02, 0.08)
    nozzle = turned([(throat, 0.0), (throat * rng.uniform(2, 4), rng.uniform(0.1, 0.4))], (0, 0, 0))
    add(scene, name, _outward(nozzle, _direction(rng), size), _any(rng, materials))


def _add_shield(scene: trimesh.Scene, name: str, rng: np.random.Generator, materials: Materials, size: Float) -> None:
    """A plate beside the bus, larger than it."""
    plate = box((*(size[:2] * rng.uniform(0.9, 2.2, 2)), 0.02), (0, 0, rng.uniform(0.02, 0.3)))
    add(scene, name, _outward(plate, np.array([0, 0, rng.choice([-1.0, 1.0])]), size), _any(rng, materials))


def _outward(part: trimesh.Trimesh, to: Float, size: Float) -> trimesh.Trimesh:
    """A part modelled along +z from the origin, turned into a direction and moved to the bus's surface."""
    part.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), to))
    part.apply_translation(0.5 * size * to / np.abs(to).max() * 0.95)
    return part


def _direction(rng: np.random.Generator) -> Float:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)
