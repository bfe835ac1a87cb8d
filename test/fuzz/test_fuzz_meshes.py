"""CAD files in every format, changed in all ways."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import trimesh
from mutator import mutated, spliced
from PIL import Image

from hat_ros.target.loading import load_target


def ball() -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.4)
    mesh.visual.vertex_colors = np.random.default_rng(0).integers(0, 256, (len(mesh.vertices), 4), dtype=np.uint8)
    return mesh


def textured() -> trimesh.Trimesh:
    mesh = trimesh.creation.box((0.3, 0.4, 0.5))
    image = Image.fromarray(np.random.default_rng(1).integers(0, 256, (8, 8, 3), dtype=np.uint8))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image, metallicFactor=0.2, roughnessFactor=0.5)
    mesh.visual = trimesh.visual.TextureVisuals(uv=mesh.vertices[:, :2] + 0.5, material=material)
    return mesh


def with_header(glb: bytes, rng) -> bytes:
    """A GLB whose JSON is changed and whose lengths are right again."""
    size = struct.unpack("<I", glb[12:16])[0]
    header = mutated(glb[20 : 20 + size], rng, is_text=True)
    header += b" " * (-len(header) % 4)
    rest = glb[20 + size :]
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(header) + len(rest), len(header), b"JSON") + header + rest


SEEDS = {
    "obj": [ball().export(file_type="obj").encode(), b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nf -3/1/1 2 3/1\n"],
    "stl": [ball().export(file_type="stl"), ball().export(file_type="stl_ascii").encode()],
    "ply": [ball().export(file_type="ply"), ball().export(file_type="ply", encoding="ascii")],
    "glb": [ball().export(file_type="glb"), textured().export(file_type="glb")],
}


@pytest.mark.parametrize("suffix", SEEDS)
def test_cad(suffix, fuzz, tmp_path):
    def make(rng):
        index = rng.randrange(2)
        data = SEEDS[suffix][index]
        if rng.random() < 0.1:
            return spliced(data, SEEDS[suffix][1 - index], rng)
        if suffix == "glb" and rng.random() < 0.6:
            return with_header(data, rng)
        return mutated(data, rng, is_text=suffix == "obj" or (suffix in ("stl", "ply") and index == 1))

    def read(data):
        path = tmp_path / f"model.{suffix}"
        path.write_bytes(data)
        return load_target(path)

    fuzz(f"mesh_{suffix}", make, read)
