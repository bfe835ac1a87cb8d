"""Mesh files from others: what they declare is checked before a parser allocates anything."""

from __future__ import annotations

import io
import json
import logging
import os
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import trimesh

from hat_ros.array_types import Float
from hat_ros.config.yaml_text import read_yaml
from hat_ros.errors import ConfigError, MeshError
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry, symmetry_from_declaration
from hat_ros.target.brep import BREP_SUFFIXES, glb_of_brep
from hat_ros.target.companions import MATERIAL_SUFFIX, Companions, copy_with_companions, say_once
from hat_ros.target.obj_text import material_libraries, plain_obj
from hat_ros.target.units import AUTO

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".glb", *BREP_SUFFIXES)
_SYMMETRY_KEYS = ("symmetries_discrete", "symmetries_continuous")
_TARGET_KEYS = ("mesh", "unit_scale", "name", "T_label_cad", *_SYMMETRY_KEYS)
MAX_FILE_BYTES = 256 * 2**20
MAX_FACES = 4_000_000
MAX_VERTICES = 8_000_000
MAX_NODES = 20_000


def read_target_yaml(path: Path) -> tuple[Path, float | None, str, Symmetry | None, Float]:
    """Mesh file, metres per unit (None = to be guessed), name, declared symmetry and ``T_label_cad`` (4, 4).

    Raises:
        MeshError: malformed, or the mesh does not lie beside it.
    """
    try:
        data = read_yaml(path)
    except ConfigError as error:
        raise MeshError(str(error)) from None
    if not isinstance(data, dict) or not isinstance(data.get("mesh"), str):
        raise MeshError(f"{path}: expected a mapping with the key 'mesh' naming a file beside it")
    unknown = sorted(set(map(str, data)) - set(_TARGET_KEYS))
    if unknown:
        raise MeshError(f"{path}: unknown key '{unknown[0]}', known keys are {', '.join(_TARGET_KEYS)}")
    scale = data.get("unit_scale", 1.0)
    if scale != AUTO and (isinstance(scale, bool) or not isinstance(scale, (int, float))):
        raise MeshError(f"{path}: unit_scale must be a number or '{AUTO}', found {scale!r}")
    mesh = (path.parent / data["mesh"]).resolve()
    if path.parent.resolve() not in mesh.parents:
        raise MeshError(f"{path}: mesh '{data['mesh']}' must lie in the same folder")
    if mesh.suffix.lower() not in MESH_SUFFIXES:
        raise MeshError(f"{path}: mesh '{data['mesh']}' must be one of {', '.join(MESH_SUFFIXES)}")
    T_label_cad = _rigid(data.get("T_label_cad"), path)
    symmetry = None
    if set(_SYMMETRY_KEYS) & set(data):
        try:
            discrete, continuous = (data.get(key, []) for key in _SYMMETRY_KEYS)
            symmetry = symmetry_from_declaration(discrete, continuous, unit_m=1.0)
        except ValueError as error:
            raise MeshError(f"{path}: {error}") from None
    return mesh, None if scale == AUTO else float(scale), str(data.get("name", mesh.stem)), symmetry, T_label_cad


def _rigid(value: object, path: Path) -> Float:
    """``T_label_cad``: the identity when it is not stated."""
    if value is None:
        return np.eye(4)
    try:
        T = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        T = np.zeros(0)
    if T.shape != (4, 4) or not lie.is_rigid(T, 1e-6):
        raise MeshError(
            f"{path}: T_label_cad must be four rows of four numbers, a rotation and a shift in metres that take points "
            f"of the CAD file to the frame of the labels"
        )
    return T


def read_scene(path: Path) -> trimesh.Scene:
    """A mesh file as ``trimesh`` reads it, after the checks of this module.

    What it names and is not used (missing material files and textures, bytes after the end) is a warning.

    Raises:
        MeshError: missing, another format, too large, or not readable as what it claims to be.
    """
    scene, files = _read(path)
    for sentence in (*files.problems, *_unknown_materials(path, files)):
        say_once(sentence)
    return scene


def companions_of(path: Path) -> dict[str, Path]:
    """What a mesh names and has beside it: path relative to the mesh's folder -> file; errors of :func:`read_scene`."""
    marks = {".obj": b"mtllib", ".ply": b"TextureFile", ".glb": b'"uri"'}
    # Large models are read once more only if they name anything.
    is_named = path.suffix.lower() in marks and os.path.isfile(path) and marks[path.suffix.lower()] in path.read_bytes()
    return _read(path)[1].found if is_named else {}


def copy_model(mesh: Path, folder: Path, stem: str | None = None) -> str:
    """Copy a mesh and what it names into a folder; STEP and IGES as the GLB that they become, for any machine to read.

    Args:
        mesh: the file.
        folder: where to.
        stem: name there without suffix, by default the file's own.

    Returns:
        Name of the copy.

    Raises:
        MeshError: unreadable, or something that the mesh names would replace a file that is there already.
    """
    stem = mesh.stem if stem is None else stem
    if mesh.suffix.lower() in BREP_SUFFIXES:
        (folder / f"{stem}.glb").write_bytes(glb_of_brep(mesh))
        return f"{stem}.glb"
    name = f"{stem}{mesh.suffix}"
    copy_with_companions(mesh, companions_of(mesh), folder, name)
    return name


def _read(path: Path) -> tuple[trimesh.Scene, Companions]:
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise MeshError(f"CAD model {path.name}: format '{suffix}' is not supported, give {', '.join(MESH_SUFFIXES)}")
    if not os.path.isfile(path):  # Path.is_file raises for names that are too long
        raise MeshError(f"CAD model {path}: no such file")
    size = path.stat().st_size
    if not 0 < size <= MAX_FILE_BYTES:
        raise MeshError(f"CAD model {path.name}: the file has {size} bytes, expected 1 to {MAX_FILE_BYTES}")
    checks = {".glb": _check_glb, ".ply": _check_ply}
    checks.get(suffix, _check_archive)(path)
    source: Path | io.BytesIO = path
    libraries: list[str] = []
    if suffix == ".obj":
        text = plain_obj(path.read_bytes(), path.name)
        source, libraries = io.BytesIO(text), material_libraries(text)
    elif suffix == ".stl":
        source = io.BytesIO(_stl_of_declared_size(path))
    elif suffix in BREP_SUFFIXES:
        source = io.BytesIO(glb_of_brep(path))
    files = Companions(path, libraries)
    file_type = "glb" if suffix in BREP_SUFFIXES else suffix[1:]
    try:
        # Numbers that do not fit a format's types are found in what it gives; numpy need not warn.
        with _silent_trimesh(), np.errstate(all="ignore"):
            scene = trimesh.load_scene(source, file_type=file_type, resolver=files, process=False)
    except Exception as error:  # parsers raise whatever the broken bytes lead them to
        raise MeshError(
            f"CAD model {path.name}: not a readable {suffix[1:]} file ({type(error).__name__}: {_short(error)})"
        ) from None
    _check_scene(scene, path.name)
    return scene, files


@contextmanager
def _silent_trimesh() -> Iterator[None]:
    """Without the tracebacks that ``trimesh`` logs for files that it does not find: they are reported in a sentence."""
    log = logging.getLogger("trimesh")
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before


def _unknown_materials(path: Path, files: Companions) -> Iterator[str]:
    """A sentence on the materials that the faces of an OBJ name and that its material file does not define."""
    libraries = [file for file in files.found.values() if file.suffix.lower() == MATERIAL_SUFFIX]
    if path.suffix.lower() != ".obj" or not (libraries or not files.problems):
        return
    used = set(re.findall(rb"^\s*usemtl[ \t]+(\S[^\r\n]*?)\s*$", path.read_bytes(), re.MULTILINE))
    text = b"\n".join(file.read_bytes() for file in libraries)
    missing = used - set(re.findall(rb"^\s*newmtl[ \t]+(\S[^\r\n]*?)\s*$", text, re.MULTILINE))
    if missing:
        names = ", ".join(sorted(name.decode("utf-8", "replace") for name in missing)[:5])
        yield f"CAD model {path.name}: no material file that it names defines '{names}': these faces are grey"


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:160]


def _check_scene(scene: trimesh.Scene, name: str) -> None:
    """Count what the scene graph would expand to before expanding it: instances multiply."""
    nodes = scene.graph.nodes_geometry
    if len(nodes) > MAX_NODES:
        raise MeshError(f"CAD model {name}: {len(nodes)} placed parts, at most {MAX_NODES} are accepted")
    meshes = [scene.geometry[scene.graph[node][1]] for node in nodes]
    meshes = [mesh for mesh in meshes if isinstance(mesh, trimesh.Trimesh)]
    n_faces = sum(len(mesh.faces) for mesh in meshes)
    if n_faces > MAX_FACES:
        raise MeshError(f"CAD model {name}: {n_faces} triangles, at most {MAX_FACES} are accepted; simplify it")


def _check_archive(path: Path) -> None:
    """Formats that declare little: refuse archives in disguise."""
    with path.open("rb") as file:
        head = file.read(4)
    if head in (b"PK\x03\x04", b"\x1f\x8b\x08\x00", b"7z\xbc\xaf") or head[:2] == b"\x1f\x8b":
        raise MeshError(f"CAD model {path.name}: it is an archive, not a {path.suffix[1:]} file; unpack it first")


def _stl_of_declared_size(path: Path) -> bytes:
    """A binary STL up to its last triangle; exporters append bytes. ASCII comes back as it is."""
    data = path.read_bytes()
    is_text = data.lstrip()[:5].lower() == b"solid"
    if len(data) < 84:
        return data
    declared = 84 + 50 * struct.unpack("<I", data[80:84])[0]
    if is_text and declared > len(data):  # text read as a count is far too large
        return data
    if declared > len(data):
        raise MeshError(
            f"CAD model {path.name}: its STL header declares {(declared - 84) // 50} triangles, {declared} bytes, the "
            f"file has {len(data)}: export it again"
        )
    if declared < len(data) and declared > 84:
        say_once(f"CAD model {path.name}: {len(data) - declared} bytes after its last triangle are ignored")
    return data[:declared]


def _check_ply(path: Path) -> None:
    with path.open("rb") as file:
        head = file.read(65536)
    if not head.startswith(b"ply") or b"end_header" not in head:
        raise MeshError(f"CAD model {path.name}: it does not start with a PLY header")
    for line in head.split(b"end_header")[0].splitlines():
        words = line.split()
        if len(words) == 3 and words[0] == b"element":
            count = int(words[2]) if words[2].isdigit() else -1
            # The smallest element that carries anything takes a byte.
            if not 0 <= count <= path.stat().st_size:
                raise MeshError(
                    f"CAD model {path.name}: the PLY header declares {words[2].decode('ascii', 'replace')} "
                    f"'{words[1].decode('ascii', 'replace')}' elements, more than the file can hold"
                )


def _check_glb(path: Path) -> None:
    """What the JSON chunk declares must fit the file: sparse accessors and shared nodes can declare gigabytes."""
    with path.open("rb") as file:
        head = file.read(20)
        if len(head) < 20 or head[:4] != b"glTF" or head[16:20] != b"JSON":
            raise MeshError(f"CAD model {path.name}: it is not a binary glTF 2.0 (GLB) file")
        version, _, json_bytes = struct.unpack("<III", head[4:16])
        if version != 2 or json_bytes > path.stat().st_size:
            raise MeshError(f"CAD model {path.name}: GLB version {version} or a truncated header; export as glTF 2.0")
        try:
            tree = json.loads(file.read(json_bytes))
        except (ValueError, RecursionError):
            raise MeshError(f"CAD model {path.name}: its GLB header is not valid JSON") from None
    if not isinstance(tree, dict):
        raise MeshError(f"CAD model {path.name}: its GLB header is not a mapping")
    try:
        declared = sum(int(accessor["count"]) for accessor in tree.get("accessors", []))
        children = [child for node in tree.get("nodes", []) for child in node.get("children", [])]
    except (KeyError, TypeError, ValueError, AttributeError):
        raise MeshError(f"CAD model {path.name}: its GLB header is malformed") from None
    if declared > MAX_VERTICES * 4:
        raise MeshError(f"CAD model {path.name}: its header declares {declared} values, more than is accepted")
    if len(children) != len(set(map(str, children))) or len(tree.get("nodes", [])) > MAX_NODES:
        raise MeshError(f"CAD model {path.name}: its scene graph is not a tree of at most {MAX_NODES} nodes")
