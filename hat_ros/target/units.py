"""The unit of a CAD file. Of meshes, only glTF says it; a wrong one gives a range that is wrong by the same factor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from hat_ros.target.brep import BREP_SUFFIXES
from hat_ros.target.companions import say_once

AUTO = "auto"
UNITS = {1.0: "metres", 0.01: "centimetres", 0.001: "millimetres"}
# From a one-unit cubesat to the International Space Station, and a size in the middle of that, metres.
SPACECRAFT_M = (0.1, 120.0)
_TYPICAL_M = 3.5
# Beyond these, metres, a model is almost always in another unit.
_USUAL_M = (0.03, 30.0)


def guess_unit_scale(scene: trimesh.Scene, path: Path) -> float:
    """Metres per unit of a file, and one sentence that says it.

    A glTF is in metres by definition, and STEP and IGES are made so by their own unit. Of the other formats nothing is
    known: metres if the size is that of a spacecraft, else centimetres or millimetres, whichever comes nearest to a
    spacecraft of usual size.

    Args:
        scene: the file's content.
        path: the file.
    """
    if path.suffix.lower() in (".glb", *BREP_SUFFIXES):
        return 1.0
    extent = extent_of(scene)
    low, high = SPACECRAFT_M
    fitting = [scale for scale in UNITS if low <= scale * extent <= high]
    if not fitting:
        say_once(
            f"CAD model {path.name}: its largest extent is {extent:.3g} units, no spacecraft in {_listed(UNITS)}; "
            f"taken as metres: set unit_scale to the metres per unit of the file"
        )
        return 1.0
    best = 1.0 if 1.0 in fitting else min(fitting, key=lambda scale: abs(np.log(scale * extent / _TYPICAL_M)))
    others = _alternatives(extent, best)
    say_once(
        f"CAD model {path.name}: unit_scale auto takes its {extent:.3g} units as {best * extent:.3g} m ({UNITS[best]}, "
        f"{best:g}){f', not {others}' if others else ''}: if that is wrong, state unit_scale as a number"
    )
    return best


def warn_of_size(extent_m: float, name: str, unit_scale: float) -> None:
    """A warning of a size that few targets have, with what other units would make of it."""
    low, high = _USUAL_M
    if low <= extent_m <= high:
        return
    others = _alternatives(extent_m / unit_scale, unit_scale)
    say_once(
        f"CAD model {name}: its largest extent is {extent_m:.3g} m with unit_scale {unit_scale:g}, "
        f"{'small' if extent_m < low else 'large'} for a target"
        f"{f'; it would be {others}' if others else ''}: check unit_scale, all ranges are wrong by the same factor"
    )


def extent_of(scene: trimesh.Scene) -> float:
    """Largest side of the box around all faces, in units of the file; 0 without faces."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for node in scene.graph.nodes_geometry:
        T, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            points = np.asarray(mesh.vertices, dtype=np.float64)[np.unique(mesh.faces)] @ T[:3, :3].T + T[:3, 3]
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    return float(np.max(high - low)) if np.isfinite(low).all() else 0.0


def _alternatives(extent: float, but: float) -> str:
    low, high = SPACECRAFT_M
    fitting = [scale for scale in UNITS if low <= scale * extent <= high and abs(scale / but - 1) > 1e-6]
    return " or ".join(f"{scale * extent:.3g} m in {UNITS[scale]} ({scale:g})" for scale in fitting)


def _listed(units: dict[float, str]) -> str:
    names = list(units.values())
    return f"{', '.join(names[:-1])} or {names[-1]}"
