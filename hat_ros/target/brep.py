"""STEP and IGES files, converted to glTF by OpenCASCADE (package ``cascadio``, the extra ``cad``).

The converter runs in a process of its own: a damaged file may crash it. What it made is kept in the cache. Axes stay,
lengths become metres by the unit that the file states.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from hat_ros.cache import cached_arrays
from hat_ros.errors import MeshError, MissingDependencyError

BREP_SUFFIXES = (".step", ".stp", ".iges", ".igs")
_TIMEOUT_S = 900
_JSON = 0x4E4F534A  # type of the first chunk of a GLB
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
    key = f"2 {path.suffix.lower()} {hashlib.sha256(path.read_bytes()).hexdigest()}"
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
    return _in_metres(data) if kind == "iges" else data


def _in_metres(glb: bytes) -> bytes:
    """The same file under a node that scales by 0.001: of IGES, ``cascadio`` writes millimetres whatever its unit."""
    (length,) = struct.unpack("<I", glb[12:16])
    tree, rest = json.loads(glb[20 : 20 + length]), glb[20 + length :]
    for scene in tree["scenes"]:
        tree["nodes"].append({"scale": [1e-3] * 3, "children": scene["nodes"]})
        scene["nodes"] = [len(tree["nodes"]) - 1]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    return glb[:8] + struct.pack("<III", 20 + len(text) + len(rest), len(text), _JSON) + text + rest
