"""Mesh files and target.yaml from others: what is refused, and how."""

import io
import json
import struct
import zipfile

import numpy as np
import pytest
import trimesh

from hat_ros.errors import MeshError
from hat_ros.target.loading import load_target


def box(extents=(1.0, 2.0, 3.0)):
    return trimesh.creation.box(extents)


def write_glb(path, document, binary=b""):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if binary:
        chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)


def test_target_yaml_names_mesh_scale_and_name(tmp_path):
    box((100, 200, 300)).export(tmp_path / "box.stl")
    yaml = tmp_path / "target.yaml"
    yaml.write_text("mesh: box.stl\nunit_scale: 0.001\nname: crate\n")
    target = load_target(yaml)
    assert target.name == "crate"
    assert target.diameter_m == pytest.approx(0.1 * np.sqrt(14), rel=1e-5)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("mesh: [", "not valid YAML"),
        ("- 1", "key 'mesh'"),
        ("mesh: box.stl\nscale: 2", "unknown key 'scale'"),
        ("mesh: box.stl\nunit_scale: big", "unit_scale must be a number"),
        ("mesh: box.stl\nunit_scale: -1", "unit_scale must be a positive number"),
        ("mesh: ../outside/box.stl", "same folder"),
        ("mesh: box.zip", "must be one of"),
        ("mesh: gone.stl", "no such file"),
    ],
)
def test_bad_target_yaml(tmp_path, text, says):
    box().export(tmp_path / "box.stl")
    yaml = tmp_path / "target.yaml"
    yaml.write_text(text)
    with pytest.raises(MeshError, match=says):
        load_target(yaml)


def test_missing_file(tmp_path):
    with pytest.raises(MeshError, match="no such file"):
        load_target(tmp_path / "gone.ply")


@pytest.mark.parametrize("name", ["model.fbx", "model.zip", "model.gltf", "model"])
def test_other_formats_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"whatever")
    with pytest.raises(MeshError, match="not supported"):
        load_target(tmp_path / name)


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb"])
@pytest.mark.parametrize("content", [b"", b"\0" * 300, b"PK\x03\x04" + b"\0" * 200, bytes(range(256)) * 3])
def test_random_bytes_are_refused(tmp_path, suffix, content):
    path = tmp_path / f"noise.{suffix}"
    path.write_bytes(content)
    with pytest.raises(MeshError):
        load_target(path)


@pytest.mark.parametrize("suffix", ["ply", "stl", "glb"])
def test_truncated_files_are_refused(tmp_path, suffix):
    path = tmp_path / f"cut.{suffix}"
    box().export(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(MeshError):
        load_target(path)


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb"])
def test_archive_under_another_name_is_refused(tmp_path, suffix):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("big.obj", b"0" * 10_000_000)
    path = tmp_path / f"bomb.{suffix}"
    path.write_bytes(data.getvalue())
    with pytest.raises(MeshError):
        load_target(path)


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb"])
def test_damaged_bytes_give_a_model_or_a_clear_error(tmp_path, suffix):
    path, rng = tmp_path / f"m.{suffix}", np.random.default_rng(0)
    trimesh.creation.icosphere(subdivisions=1).export(path)
    whole = path.read_bytes()
    for _ in range(40):
        data = bytearray(whole)
        for place in rng.integers(len(data), size=3):
            data[place] = rng.integers(32, 127)
        path.write_bytes(data)
        try:
            target = load_target(path)
        except MeshError:
            continue
        assert np.isfinite(target.vertices_m).all() and np.isfinite(target.diameter_m)


def test_a_file_without_triangles_is_refused(tmp_path):
    path = tmp_path / "points.ply"
    trimesh.PointCloud(np.eye(3)).export(path)
    with pytest.raises(MeshError, match="no triangles"):
        load_target(path)


def test_ply_that_declares_more_than_it_holds_is_refused(tmp_path):
    path = tmp_path / "bomb.ply"
    path.write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\nproperty float x\n"
        b"property float y\nproperty float z\nend_header\n"
    )
    with pytest.raises(MeshError, match="more than the file can hold"):
        load_target(path)


def test_glb_that_declares_gigabytes_is_refused(tmp_path):
    path = tmp_path / "bomb.glb"
    write_glb(
        path, {"asset": {"version": "2.0"}, "accessors": [{"count": 10**10, "componentType": 5126, "type": "VEC3"}]}
    )
    with pytest.raises(MeshError, match="declares"):
        load_target(path)


def test_glb_whose_nodes_share_children_is_refused(tmp_path):
    nodes = [{"children": [i + 1, i + 1]} for i in range(30)] + [{}]
    path = tmp_path / "dag.glb"
    write_glb(path, {"asset": {"version": "2.0"}, "nodes": nodes})
    with pytest.raises(MeshError, match="not a tree"):
        load_target(path)


@pytest.mark.parametrize("document", [[], {"accessors": [{}]}, {"nodes": [{"children": 3}]}])
def test_glb_with_malformed_header_is_refused(tmp_path, document):
    path = tmp_path / "odd.glb"
    write_glb(path, document)
    with pytest.raises(MeshError):
        load_target(path)


def stl_of(mesh, header=b"made by hand", tail=b""):
    data = mesh.export(file_type="stl")
    return header.ljust(80, b" ")[:80] + data[80:] + tail


@pytest.mark.parametrize("header", [b"made by hand", b"solid box"])
@pytest.mark.parametrize("tail", [b"\0\0", b"\r\n", b"x" * 49, bytes(200)])
def test_bytes_after_the_last_triangle_are_ignored_with_one_warning(tmp_path, caplog, header, tail):
    path = tmp_path / f"{header[:5].decode()}{len(tail)}{tail[0]}.stl"
    path.write_bytes(stl_of(box(), header, tail))
    assert load_target(path).faces.shape == load_target(path).faces.shape == (12, 3)
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == [
        f"CAD model {path.name}: {len(tail)} bytes after its last triangle are ignored"
    ]


@pytest.mark.parametrize("tail", ["", "\n\n", "\x1a", "\0\0"])
def test_ascii_stl_with_bytes_after_its_end(tmp_path, tail):
    path = tmp_path / "text.stl"
    path.write_text(box().export(file_type="stl_ascii") + tail)
    assert load_target(path).faces.shape == (12, 3)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb"])
def test_degenerate_triangles_are_removed_without_a_word(tmp_path, caplog, suffix):
    good = box()
    points = np.vstack([good.vertices, [[5, 0, 0], [6, 0, 0], [7, 0, 0]]])
    empty = [[8, 9, 10], [0, 0, 1], [2, 2, 2], [8, 8, 8]]
    mesh = trimesh.Trimesh(points, np.vstack([good.faces, empty]), process=False)
    path = tmp_path / f"thin.{suffix}"
    mesh.export(path)
    if suffix == "obj":
        path.write_text(path.read_text() + "vn nan nan nan\nf 1//1 2//1 2//1\nf 1//1 2//1 4//1\n")
    target = load_target(path)
    assert len(target.vertices_m) == 8 and np.isfinite(target.surface.corner_normal).all()
    np.testing.assert_allclose(target.center_m, 0, atol=1e-7)
    assert not [record for record in caplog.records if record.levelname == "WARNING"]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("stray", ["9 9 9", "nan 0 0", "inf 0 0", "1e300 0 0"])
def test_a_vertex_that_no_face_uses_is_ignored_whatever_it_is(tmp_path, stray):
    path = tmp_path / "stray.obj"
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in box().vertices)
    faces = "".join(f"f {a} {b} {c}\n" for a, b, c in box().faces + 2)
    path.write_text(f"v {stray}\n{vertices}{faces}")
    target = load_target(path)
    assert len(target.vertices_m) == 8
    np.testing.assert_allclose(target.center_m, 0, atol=1e-7)
    assert target.bounding_radius_m == pytest.approx(np.sqrt(14) / 2)


@pytest.mark.parametrize("line", ["v 1 2", "v 1", "v 1 x 2"])
def test_a_vertex_with_too_few_coordinates_is_one_sentence(tmp_path, line):
    path = tmp_path / "short.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\n{line}\nf 1 2 3\n")
    with pytest.raises(MeshError, match="short"):
        load_target(path)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("suffix", ["obj", "ply", "stl"])
def test_text_meshes_damaged_at_random_give_a_model_or_one_sentence(tmp_path, suffix):
    rng, path = np.random.default_rng(3), tmp_path / f"fuzz.{suffix}"
    if suffix == "obj":
        whole = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nf -3/-1/-1 -2/-1/-1 -1/-1/-1\nv 0 0 1\nf -1 1 2\n" * 3
    else:
        ball = trimesh.creation.icosphere(1)
        text = ball.export(file_type="stl_ascii") if suffix == "stl" else ball.export(file_type="ply", encoding="ascii")
        whole = text.encode() if isinstance(text, str) else text
    pieces = [b"-", b"nan", b"/", b" ", b"\\\n", b"\nf ", b"\n", b"1e999", b"usemtl x\n", b"\nv 1 2"]
    for _ in range(150):
        data = bytearray(whole)
        for _ in range(rng.integers(1, 5)):
            at = int(rng.integers(len(data)))
            data[at : at + int(rng.integers(0, 8))] = pieces[rng.integers(len(pieces))]
        path.write_bytes(data)
        try:
            target = load_target(path)
        except MeshError as error:
            assert "\n" not in str(error)
            continue
        assert np.isfinite(target.vertices_m).all() and np.isfinite(target.face_normals).all()
        assert np.isfinite(target.surface.corner_normal).all()
