"""Spacecraft models of the project's own making, so that tests, demo and benchmark need no files of others.

All are in metres, z up along the body's long axis, wings along y. They are built from boxes and turned parts with
drawn textures; :func:`build_model` gives the scene, :func:`write_model` a GLB file.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial

from hat_ros.bench.synth.parts import TILE_M, add, box, foil, moved, plain, solar_cells, turned
from hat_ros.errors import UsageError
from hat_ros.target.loading import target_from_scene
from hat_ros.target.model import Target


def model_names() -> list[str]:
    """Names that :func:`build_model` knows."""
    return sorted(_BUILDERS)


def build_model(name: str, asymmetry: float = 1.0) -> trimesh.Scene:
    """A spacecraft model.

    Args:
        name: see :func:`model_names`.
        asymmetry: 1 = clearly asymmetric; towards 0 the parts that tell the model from its half-turned self (about
            z) shrink to nothing and their colours fade, so that single images become ambiguous.

    Raises:
        UsageError: unknown name, or asymmetry outside 0..1.
    """
    if name not in _BUILDERS:
        raise UsageError(f"model '{name}' does not exist, known are {', '.join(model_names())}")
    if not 0 <= asymmetry <= 1:
        raise UsageError(f"asymmetry must be between 0 and 1, found {asymmetry}")
    return _BUILDERS[name](asymmetry)


def build_target(name: str, asymmetry: float = 1.0) -> Target:
    """The model as a :class:`Target`, without going through a file."""
    return target_from_scene(build_model(name, asymmetry), name)


def write_model(name: str, path: Path, asymmetry: float = 1.0) -> None:
    """Write the model as GLB."""
    path.write_bytes(build_model(name, asymmetry).export(file_type="glb"))


def _observer(asymmetry: float) -> trimesh.Scene:
    """A foil-wrapped observation satellite, 2.6 m over two wings; nearly itself after half a turn about z."""
    m = _materials()
    scene = trimesh.Scene()
    add(scene, "bus", box((0.8, 0.7, 1.0)), m["foil"])
    add(scene, "deck_top", box((0.84, 0.74, 0.05), (0, 0, 0.52)), m["white"])
    add(scene, "deck_bottom", box((0.84, 0.74, 0.05), (0, 0, -0.52)), m["grey"])
    for side in (1, -1):
        for axis in (0.41, -0.41):  # radiators and equipment boxes on both x faces, alike under the half turn
            add(scene, f"radiator{side}{axis}", box((0.02, 0.5, 0.35), (axis * 1.0, 0.05 * side, 0.2)), m["white"])
        add(scene, f"box{side}", box((0.12, 0.22, 0.2), (0.45 * side, -0.18 * side, -0.25)), m["grey"])
        add(scene, f"yoke{side}", box((0.03, 0.2, 0.03), (0, side * 0.44, 0)), m["dark"])
        for panel in range(2):
            y = side * (0.54 + 0.19 + panel * 0.40)
            add(scene, f"wing{side}_{panel}", box((0.02, 0.38, 0.9), (0, y, 0)), m["cells"])
    add(scene, "telescope", turned([(0.0, 0.0), (0.24, 0.0), (0.24, 0.34), (0.21, 0.34), (0.21, 0.06), (0.0, 0.06)],
                                     (0, 0, 0.545)), m["dark"])  # fmt: skip
    add(scene, "nozzle", turned([(0.05, 0.0), (0.16, -0.18)], (0, 0, -0.545)), m["dark"])
    # What breaks the half-turn symmetry.
    if asymmetry > 0:
        dish = turned([(0.0, 0.0), (0.12, 0.02), (0.22, 0.08), (0.3, 0.17)], (0, 0, 0))
        dish.apply_transform(trimesh.transformations.rotation_matrix(np.radians(80), (0, 1, 0)))
        dish.apply_scale(asymmetry)
        add(scene, "dish", moved(dish, (0.43, 0.0, -0.02)), m["white"])
        boom = box((0.9 * asymmetry, 0.03, 0.03), (-0.4 - 0.45 * asymmetry, 0.2, 0.35))
        add(scene, "boom", boom, m["grey"])
        add(scene, "boom_head", box((0.1 * asymmetry,) * 3, (-0.4 - 0.9 * asymmetry, 0.2, 0.35)), m["red"])
    return scene


def _cubesat(asymmetry: float) -> trimesh.Scene:
    """A 3U CubeSat, 0.34 m long, with four deployed panels and a patch antenna."""
    m = _materials(0.1)
    scene = trimesh.Scene()
    add(scene, "body", box((0.1, 0.1, 0.34)), m["cells"], 0.1)
    for rail, (x, y) in enumerate([(1, 1), (1, -1), (-1, 1), (-1, -1)]):
        add(scene, f"rail{rail}", box((0.012, 0.012, 0.35), (0.046 * x, 0.046 * y, 0)), m["grey"])
    for side in (1, -1):
        add(scene, f"wing_y{side}", box((0.09, 0.3, 0.003), (0, side * 0.2, 0.17)), m["cells"], 0.1)
        add(scene, f"wing_x{side}", box((0.2, 0.09, 0.003), (side * 0.15, 0, 0.17)), m["cells"], 0.1)
    add(scene, "lens", turned([(0.0, 0.0), (0.035, 0.0), (0.03, -0.02), (0.0, -0.02)], (0, 0, -0.172)), m["dark"])
    if asymmetry > 0:
        add(scene, "patch", box((0.006, 0.07 * asymmetry, 0.07 * asymmetry), (0.053, 0, -0.08)), m["white"])
        add(scene, "antenna", box((0.003, 0.003, 0.17 * asymmetry), (-0.045, 0.03, -0.17 - 0.085 * asymmetry)),
             m["red"])  # fmt: skip
    return scene


def _freighter(asymmetry: float) -> trimesh.Scene:
    """A cargo ship: a body of revolution 3.2 m long with two wings; a symmetry of 180 degrees but for small parts."""
    m = _materials()
    scene = trimesh.Scene()
    outline = [(0.0, 1.6), (0.5, 1.6), (0.55, 1.45), (0.8, 1.25), (0.8, -0.6), (0.7, -0.75), (0.7, -1.2), (0.25, -1.2),
               (0.38, -1.6)]  # fmt: skip
    add(scene, "hull", turned(outline, (0, 0, 0)), m["white"])
    add(scene, "band", turned([(0.81, 0.1), (0.815, 0.1), (0.815, -0.5), (0.81, -0.5)], (0, 0, 0)), m["foil"])
    for side in (1, -1):
        add(scene, f"yoke{side}", box((0.05, 0.3, 0.05), (0, side * 0.85, -0.95)), m["grey"])
        add(scene, f"wing{side}", box((0.03, 1.4, 0.7), (0, side * 1.7, -0.95)), m["cells"])
        add(scene, f"thruster{side}", box((0.15, 0.15, 0.3), (side * 0.8, 0, 1.0)), m["dark"])
    if asymmetry > 0:
        add(scene, "grapple", box((0.18 * asymmetry, 0.3 * asymmetry, 0.3 * asymmetry), (0.82, 0.0, 0.45)), m["red"])
        add(scene, "sensor", box((0.12 * asymmetry, 0.12, 0.5), (-0.82, 0.25, 0.3)), m["dark"])
    return scene


def _probe(asymmetry: float) -> trimesh.Scene:
    """A science probe without wings: a box with a large dish and three booms of different length."""
    m = _materials()
    scene = trimesh.Scene()
    add(scene, "bus", box((0.9, 0.9, 0.6)), m["foil"])
    add(scene, "panel", box((0.92, 0.6, 0.3), (0, 0, 0.02)), m["cells"])
    add(scene, "dish", turned([(0.0, 0.0), (0.3, 0.04), (0.55, 0.14), (0.75, 0.28)], (0, 0, 0.32)), m["white"])
    add(scene, "feed", turned([(0.0, 0.5), (0.06, 0.5), (0.06, 0.42), (0.0, 0.42)], (0, 0, 0.32)), m["dark"])
    for leg, angle in enumerate(np.radians([90, 210, 330])):
        strut = trimesh.creation.cylinder(
            0.012, segment=[(0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.44), (0, 0, 0.8)], sections=8
        )
        add(scene, f"strut{leg}", strut, m["grey"])
    for boom, (direction, length) in enumerate([((1, 0), 1.4), ((-0.5, 0.8), 0.9), ((-0.5, -0.8), 0.6)]):
        length = 0.9 + asymmetry * (length - 0.9)
        end = np.array([*direction, -0.2]) / np.linalg.norm([*direction, -0.2])
        start, tip = 0.45 * end, (0.45 + length) * end
        add(scene, f"boom{boom}", trimesh.creation.cylinder(0.02, segment=[start, tip], sections=10), m["grey"])
        add(scene, f"head{boom}", moved(trimesh.creation.icosphere(2, 0.07), tip), m["dark" if boom else "red"])
    return scene


_BUILDERS: dict[str, Callable[[float], trimesh.Scene]] = {
    "observer": _observer,
    "cubesat": _cubesat,
    "freighter": _freighter,
    "probe": _probe,
}


def _materials(tile_m: float = TILE_M) -> dict[str, PBRMaterial]:
    rng = np.random.default_rng(7)
    cells, wrinkled = solar_cells(rng), foil(rng)
    return {
        "cells": PBRMaterial(name="cells", baseColorTexture=cells, roughnessFactor=0.35, metallicFactor=0.0),
        "foil": PBRMaterial(name="foil", baseColorTexture=wrinkled, roughnessFactor=0.3, metallicFactor=0.4),
        "white": plain("white", (225, 225, 220), 0.6),
        "grey": plain("grey", (120, 122, 125), 0.5),
        "dark": plain("dark", (38, 38, 42), 0.5),
        "red": plain("red", (170, 45, 35), 0.6),
    }
