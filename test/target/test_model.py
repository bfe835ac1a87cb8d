"""CAD models: what is read, in which frame and colours, and what is refused."""

import io
import json
import struct
import zipfile

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from trimesh.visual.material import PBRMaterial

from hat_ros.errors import MeshError
from hat_ros.target.model import linear_from_srgb, load_target, srgb_from_linear, target_from_scene


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


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb"])
def test_every_format_gives_the_same_geometry_without_axis_change(tmp_path, suffix):
    path = tmp_path / f"box.{suffix}"
    box().export(path)
    target = load_target(path)
    assert target.vertices_m.shape == (8, 3) and target.faces.shape == (12, 3)
    assert target.vertices_m.dtype == np.float64 and target.faces.dtype == np.int32
    np.testing.assert_allclose(np.ptp(target.vertices_m, axis=0), [1, 2, 3], atol=1e-6)
    assert target.diameter_m == pytest.approx(np.sqrt(14), abs=1e-6)
    assert target.bounding_radius_m == pytest.approx(np.sqrt(14) / 2, abs=1e-6)
    np.testing.assert_allclose(target.center_m, 0, atol=1e-7)


def test_transforms_of_the_scene_graph_are_applied_and_axes_kept(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(box((0.2, 0.2, 0.2)), transform=trimesh.transformations.translation_matrix([0, 5, 0]))
    path = tmp_path / "moved.glb"
    scene.export(path)
    np.testing.assert_allclose(load_target(path).center_m, [0, 5, 0], atol=1e-6)


def test_unit_scale_scales_geometry_and_changes_the_hash(tmp_path):
    path = tmp_path / "box.stl"
    box((100, 200, 300)).export(path)
    metres = load_target(path, 0.001)
    np.testing.assert_allclose(np.ptp(metres.vertices_m, axis=0), [0.1, 0.2, 0.3], atol=1e-6)
    assert metres.sha256 != load_target(path, 0.01).sha256
    assert metres.sha256 == load_target(path, 0.001).sha256


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


def test_face_colours_come_from_face_vertex_material_and_texture():
    coloured = box()
    coloured.visual.face_colors = np.tile([[10, 20, 30, 255]], (12, 1))
    assert (target_from_scene(trimesh.Scene(coloured), "a").face_rgb == [10, 20, 30]).all()

    coloured = box()
    coloured.visual.vertex_colors = np.tile([[200, 100, 50, 255]], (8, 1))
    target = target_from_scene(trimesh.Scene(coloured), "b")
    assert (target.face_rgb == [200, 100, 50]).all() and target.surface.corner_rgb is not None

    image = Image.new("RGB", (4, 4), (90, 60, 30))
    image.paste((10, 200, 10), (2, 0, 4, 4))  # right half green
    textured = box()
    textured.visual = trimesh.visual.TextureVisuals(
        uv=np.tile([[0.25, 0.5]], (8, 1)), material=PBRMaterial(baseColorTexture=image)
    )
    assert (target_from_scene(trimesh.Scene(textured), "c").face_rgb == [90, 60, 30]).all()
    assert (target_from_scene(trimesh.Scene(box()), "d").face_rgb.std(axis=1) < 1e-9).all()


def test_gltf_colour_factor_is_linear():
    plain = box()
    plain.visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((8, 2)), material=PBRMaterial(baseColorFactor=[0.2158605, 1.0, 0.0, 1.0])
    )
    rgb = target_from_scene(trimesh.Scene(plain), "e").face_rgb[0].astype(int)
    assert abs(rgb[0] - 128) <= 1 and rgb[1] == 255 and rgb[2] == 0


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 255))
def test_srgb_round_trip(value):
    assert srgb_from_linear(linear_from_srgb(np.uint8(value))) == value


def test_texture_coordinates_wrap_and_v_points_up():
    image = Image.new("RGB", (2, 2))
    image.putdata([(1, 0, 0), (2, 0, 0), (3, 0, 0), (4, 0, 0)])  # rows from the top
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    mesh.visual = trimesh.visual.TextureVisuals(
        uv=[[0.25, 0.25], [0.75, 0.25], [1.25, 1.75]], material=PBRMaterial(baseColorTexture=image)
    )
    target = target_from_scene(trimesh.Scene(mesh), "f")
    face = np.zeros(3, np.int32)
    np.testing.assert_array_equal(target.surface.sample(face, np.eye(3), target.face_rgb)[:, 0], [3, 4, 1])


def test_coincident_vertices_are_merged_and_empty_faces_dropped():
    mesh = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 1e-9], [1, 0, 0], [1, 1, 0], [2, 0, 0]],
        [[0, 1, 2], [3, 4, 5], [0, 1, 6], [1, 1, 2]],
        process=False,
    )
    target = target_from_scene(trimesh.Scene(mesh), "g")
    assert len(target.vertices_m) == 4 and len(target.faces) == 2
    assert len(target.face_rgb) == len(target.surface.texture_id) == 2


def test_diameter_of_a_flat_model():
    mesh = trimesh.Trimesh([[0, 0, 0], [3, 0, 0], [0, 4, 0]], [[0, 1, 2]], process=False)
    assert target_from_scene(trimesh.Scene(mesh), "h").diameter_m == pytest.approx(5)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_diameter_is_the_largest_vertex_distance(seed):
    points = np.random.default_rng(seed).normal(size=(30, 3))
    mesh = trimesh.Trimesh(points, np.arange(30).reshape(-1, 3), process=False)
    target = target_from_scene(trimesh.Scene(mesh), "i")
    brute = np.linalg.norm(points[:, None] - points[None], axis=-1).max()
    assert target.diameter_m == pytest.approx(brute, rel=1e-9)


# ---------------------------------------------------------------- refusals


def test_missing_file(tmp_path):
    with pytest.raises(MeshError, match="no such file"):
        load_target(tmp_path / "gone.ply")


@pytest.mark.parametrize("name", ["model.step", "model.zip", "model.gltf", "model"])
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


def test_nan_vertices_are_refused():
    mesh = box()
    mesh.vertices[3, 1] = np.nan
    with pytest.raises(MeshError, match="not finite"):
        target_from_scene(trimesh.Scene(mesh), "nan")


@pytest.mark.parametrize(("scale", "says"), [(1e6, "largest extent"), (1e-6, "largest extent"), (np.nan, "positive")])
def test_absurd_extents_are_refused_with_advice(scale, says):
    with pytest.raises(MeshError, match=says):
        target_from_scene(trimesh.Scene(box()), "huge", scale)


def test_texture_bombs_are_refused_before_they_are_unpacked():
    mesh = box()
    mesh.visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((8, 2)), material=PBRMaterial(baseColorTexture=Image.new("1", (9000, 9000)))
    )
    with pytest.raises(MeshError, match="9000x9000 px"):
        target_from_scene(trimesh.Scene(mesh), "bomb")


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
