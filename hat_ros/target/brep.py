"""STEP and IGES files, converted to glTF by OpenCASCADE (package ``cascadio``, the extra ``cad``).

The converter runs in a process of its own: a damaged file may crash it. What it made is kept in the cache. Axes stay,
lengths become metres by the unit that the file states.
"""

from __future__ import annotations

import hashlib
import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from hat_ros.cache import cached_arrays
from hat_ros.errors import MeshError, MissingDependencyError

BREP_SUFFIXES = (".step", ".stp", ".iges", ".igs")
_TIMEOUT_S = 900
# Chords deviate by at most a tenth of a millimetre, or 0.2 rad of a curve.
_SCRIPT = """
import sys, cascadio
kind, source, goal = sys.argv[1:]
with open(source, "rb") as file:
    glb = cascadio.load(file.read(), file_type=kind, tol_linear=0.1, tol_angular=0.2)
with open(goal, "wb") as file:
    file.write(glb)
"""


def glb_of_brep(path: Path) -> bytes:
    """The GLB file that a STEP or IGES file becomes.

    Raises:
        MissingDependencyError: ``cascadio`` is not installed.
        MeshError: the file cannot be converted.
    """
    if importlib.util.find_spec("cascadio") is None:
        raise MissingDependencyError(
            f"CAD model {path.name}: STEP and IGES are read by the package 'cascadio', which is not installed: "
            f"`pip install cascadio`, or export the model as glb"
        )
    key = f"1 {path.suffix.lower()} {hashlib.sha256(path.read_bytes()).hexdigest()}"
    arrays = cached_arrays("brep", key, lambda: {"glb": np.frombuffer(_converted(path), np.uint8)})
    return arrays["glb"].tobytes()


def _converted(path: Path) -> bytes:
    kind = "step" if path.suffix.lower() in (".step", ".stp") else "iges"
    with tempfile.TemporaryDirectory() as folder:
        goal = Path(folder) / "model.glb"
        command = [sys.executable, "-c", _SCRIPT, kind, str(path.resolve()), str(goal)]
        try:
            subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=False)
        except subprocess.TimeoutExpired:
            raise MeshError(f"CAD model {path.name}: not converted within {_TIMEOUT_S} s, export it as glb") from None
        data = goal.read_bytes() if goal.is_file() else b""
    # A file without shapes becomes a glTF without meshes.
    if b'"meshes"' not in data:
        raise MeshError(f"CAD model {path.name}: OpenCASCADE finds no shape in this {kind.upper()} file")
    return data
