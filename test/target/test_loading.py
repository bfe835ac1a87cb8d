"""CAD models: what is read, in which frame and colours, and what is refused."""

import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from hat_ros.errors import MeshError
from hat_ros.target.loading import load_target, target_from_scene


def box(extents=(1.0, 2.0, 3.0)):
    return trimesh.creation.box(extents)


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


def test_a_gltf_mesh_of_many_materials_is_the_same_at_every_load(tmp_path):
    """trimesh gives the primitives of one node random names; the digest is the key of all caches."""
    scene = trimesh.Scene()
    for i in range(6):
        part = box((0.1 * (i + 1), 0.2, 0.2))
        part.visual = trimesh.visual.TextureVisuals(material=PBRMaterial(baseColorFactor=[0.1 * i, 0.5, 0.5, 1.0]))
        scene.add_geometry(part, transform=trimesh.transformations.translation_matrix([0, 0, float(i)]))
    path = tmp_path / "parts.glb"
    scene.export(path)
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    document, binary = json.loads(data[20 : 20 + length]), data[20 + length :]
    document["meshes"] = [{"name": "one", "primitives": [m["primitives"][0] for m in document["meshes"]]}]
    document["nodes"], document["scenes"] = [{"name": "one", "mesh": 0}], [{"nodes": [0]}]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(binary)) + struct.pack("<I4s", len(text), b"JSON")
    path.write_bytes(header + text + binary)
    loads = [load_target(path) for _ in range(4)]
    assert len(loads[0].faces) == 6 * 12
    assert len({target.sha256 for target in loads}) == 1


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


def test_coincident_vertices_are_merged_and_empty_faces_dropped():
    mesh = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 1e-9], [1, 0, 0], [1, 1, 0], [2, 0, 0]],
        [[0, 1, 2], [3, 4, 5], [0, 1, 6], [1, 1, 2]],
        process=False,
    )
    target = target_from_scene(trimesh.Scene(mesh), "g")
    assert len(target.vertices_m) == 4 and len(target.faces) == 2
    assert len(target.face_rgb) == len(target.surface.texture_id) == 2


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


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", range(5))
def test_corners_in_a_line_are_dropped_however_they_round(seed):
    rng = np.random.default_rng(seed)
    good = box().triangles
    a, step = rng.uniform(-0.4, 0.4, (200, 3)), rng.uniform(-0.3, 0.3, (200, 3))
    lines = np.stack([a, a + step, a + 2 * step], axis=1)
    lines[100:, :, 1:] = lines[100:, :1, 1:]  # along an axis: their area is zero in floating point too
    corners = np.concatenate([good, lines])
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    target = target_from_scene(trimesh.Scene(mesh), f"lines{seed}")
    assert np.isfinite(target.face_normals).all() and (target.face_areas_m2 > 0).all()
    assert len(np.unique(target.faces)) == len(target.vertices_m)
    np.testing.assert_allclose(target.face_areas_m2.sum(), 22.0, atol=1e-6)
