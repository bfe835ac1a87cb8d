"""What a mesh names beside itself: read, copied, or reported in one sentence; never from outside its folder."""

import logging

import numpy as np
import pytest
import trimesh
from PIL import Image

from hat_ros.errors import MeshError
from hat_ros.target.companions import copy_with_companions
from hat_ros.target.loading import load_target
from hat_ros.target.mesh_file import companions_of

QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


@pytest.fixture
def said(caplog):
    caplog.set_level(logging.WARNING)
    return lambda: [record.getMessage() for record in caplog.records]


def picture(path, rgb=(200, 40, 20)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (4, 4), rgb).save(path)


def obj(folder, name, map_kd="tex.png", lib="m.mtl", use="skin"):
    """A square with a material; names of models differ, since each sentence is said once."""
    (folder / lib).write_text(f"newmtl skin\nKd 0.2 0.4 0.6\n{f'map_Kd {map_kd}' if map_kd else ''}\n")
    (folder / name).write_text(f"mtllib {lib}\n{QUAD}usemtl {use}\nf 1/1 2/2 3/3 4/4\n")
    return folder / name


@pytest.mark.parametrize(
    ("place", "written"),
    [
        ("tex.png", "tex.png"),
        ("maps/tex.png", "maps/tex.png"),
        ("maps/tex.png", "maps\\tex.png"),
        ("my tex.png", "my tex.png"),
        ("tex.png", "-s 1 1 1 -clamp on tex.png"),
        ("my tex.png", "my%20tex.png"),
        ("TEX.PNG", "./TEX.PNG"),
    ],
)
def test_textures_are_found_however_they_are_named_and_copied_with_the_model(tmp_path, said, place, written):
    source, copy = tmp_path / "a", tmp_path / "b"
    source.mkdir()
    copy.mkdir()
    picture(source / place)
    mesh = obj(source, "quad.obj", written)
    found = companions_of(mesh)
    assert sorted(found) == sorted(["m.mtl", place])
    copy_with_companions(mesh, found, copy, "target.obj")
    for target in (load_target(mesh), load_target(copy / "target.obj")):
        assert (target.face_rgb == (200, 40, 20)).all()
    assert load_target(mesh).sha256 == load_target(copy / "target.obj").sha256
    assert said() == []


def test_the_texture_of_a_ply_is_copied(tmp_path):
    picture(tmp_path / "tex.png")
    (tmp_path / "m.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile tex.png\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nproperty float s\nproperty float t\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0 0.5 0.5\n1 0 0 0.5 0.5\n0 1 0 0.5 0.5\n3 0 1 2\n"
    )
    assert (load_target(tmp_path / "m.ply").face_rgb == (200, 40, 20)).all()
    assert list(companions_of(tmp_path / "m.ply")) == ["tex.png"]


def test_two_materials_in_two_files(tmp_path, said):
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\n")
    (tmp_path / "b.mtl").write_text("newmtl blue\nKd 0 0 1\n")
    path = tmp_path / "pair.obj"
    path.write_text(f"mtllib a.mtl\nmtllib b.mtl\n{QUAD}usemtl red\nf 1 2 3\nusemtl blue\nf 1 3 4\n")
    assert sorted(map(tuple, load_target(path).face_rgb.tolist())) == [(0, 0, 255), (255, 0, 0)]
    assert said() == []


@pytest.mark.parametrize("kind", ["gone", "up", "absolute", "drive", "link", "broken", "cut", "text"])
def test_a_texture_that_is_not_used_is_one_sentence(tmp_path, said, kind):
    folder = tmp_path / "models"
    folder.mkdir()
    picture(tmp_path / "out.png")
    (folder / "notes.txt").write_text("no image")
    (folder / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(40))
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    Image.fromarray(noise).save(folder / "cut.jpg")
    (folder / "cut.jpg").write_bytes((folder / "cut.jpg").read_bytes()[:2000])
    (folder / "link.png").symlink_to(tmp_path / "out.png")
    named = {
        "gone": "gone.png",
        "up": "../out.png",
        "absolute": str(tmp_path / "out.png"),
        "drive": "C:\\maps\\out.png",
        "link": "link.png",
        "broken": "broken.png",
        "cut": "cut.jpg",
        "text": "notes.txt",
    }[kind]
    mesh = obj(folder, f"quad_{kind}.obj", named)
    target = load_target(mesh)
    load_target(mesh)
    assert (target.face_rgb == (51, 102, 153)).all()
    assert len(said()) == 1 and named in said()[0] and "\n" not in said()[0]
    assert list(companions_of(mesh)) == ["m.mtl"]


def test_a_missing_material_file_and_a_missing_material_are_one_sentence_each(tmp_path, said):
    mesh = obj(tmp_path, "no_file.obj")
    (tmp_path / "m.mtl").unlink()
    assert (load_target(mesh).face_rgb == 160).all()
    assert len(said()) == 1 and "m.mtl" in said()[0]
    assert (load_target(obj(tmp_path, "no_such.obj", "", use="gloss")).face_rgb == 160).all()
    assert len(said()) == 2 and "'gloss'" in said()[1]


def test_a_model_without_any_colours_says_so_once(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    trimesh.creation.box().export(tmp_path / "bare.stl")
    assert (load_target(tmp_path / "bare.stl").face_rgb == 160).all()
    load_target(tmp_path / "bare.stl")
    said = [record.getMessage() for record in caplog.records if record.name.startswith("hat_ros")]
    assert said == ["CAD model bare: it has no colours and is taken as grey"]


def test_a_companion_never_replaces_a_file_of_the_bag(tmp_path):
    picture(tmp_path / "a" / "tex.png")
    mesh = obj(tmp_path / "a", "quad.obj")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "m.mtl").write_text("mine")
    with pytest.raises(MeshError, match=r"m\.mtl.* is taken"):
        copy_with_companions(mesh, companions_of(mesh), tmp_path / "b", "quad.obj")
    assert (tmp_path / "b" / "m.mtl").read_text() == "mine"


def test_a_damaged_texture_inside_a_glb_is_one_sentence(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    mesh = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(noise))
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.full((8, 2), 0.5), material=material)
    data = bytearray(trimesh.Scene(mesh).export(file_type="glb"))
    at = data.index(b"IDAT") + 400
    data[at : at + 5000] = bytes(5000)
    (tmp_path / "bad.glb").write_bytes(data)
    with pytest.raises(MeshError, match="one of its textures cannot be decoded"):
        load_target(tmp_path / "bad.glb")
