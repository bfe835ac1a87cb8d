"""Relative indices and other liberties of the OBJ format: the same triangles as the plain file."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from hat_ros.errors import MeshError
from hat_ros.target.loading import load_target
from hat_ros.target.obj_text import material_libraries, plain_obj


def corners_of(path):
    """Corners of all faces, sorted: what the file means, however it is written."""
    corners = load_target(path).corners_m
    return corners[np.lexsort(corners.reshape(len(corners), 9).T[::-1])]


class Writer:
    """Writes boxes at random places in random ways, and knows what they are."""

    def __init__(self, rng, style):
        self.rng, self.style = rng, style
        self.lines, self.faces, self.vertices = [], [], []
        self.n_vt = self.n_vn = 0

    def add_box(self):
        box = trimesh.creation.box(self.rng.uniform(0.2, 2, 3))
        base, offset = len(self.vertices), self.rng.uniform(-3, 3, 3)
        for vertex in box.vertices + offset:
            self.vertices.append(vertex)
            self.lines.append("v {:.6f} {:.6f} {:.6f}".format(*vertex))
        if "t" in self.style:
            self.lines += ["vt 0 0", "vt 1 0", "vt 0 1"]
            self.n_vt += 3
        if "n" in self.style:
            self.lines += ["vn 0 0 1"] * 3
            self.n_vn += 3
        if "m" in self.style:
            self.lines += [f"g part{base}", f"usemtl mat{base % 3}", "s off"]
        if "s" in self.style:  # a vertex that no face uses
            self.vertices.append(np.full(3, 900.0))
            self.lines.append("v 900 900 900")
        if "l" in self.style:
            self.lines += ["l -1 -2", "p -1"]
        for face in box.faces + base:
            self.faces.append(face)
            self.lines.append(self._face(face))

    def _face(self, face):
        relative = "a" not in self.style or self.rng.random() < 0.5
        tokens = []
        for slot, index in enumerate(face):
            v = index - len(self.vertices) if relative else index + 1
            vt, vn = (slot - 3, slot - 3) if relative else (self.n_vt - 2 + slot, self.n_vn - 2 + slot)
            token = f"{v}"
            if "t" in self.style and "n" in self.style:
                token += f"/{vt}/{vn}"
            elif "t" in self.style:
                token += f"/{vt}"
            elif "n" in self.style:
                token += f"//{vn}"
            tokens.append(token)
        joint = " \\\n" if "c" in self.style else " "
        return ("  f " if "i" in self.style else "f ") + joint.join(tokens) + (" # one" if "#" in self.style else "")

    def text(self):
        text = "\n".join(self.lines)
        return text.replace("\n", "\r\n") if "r" in self.style else text

    def corners(self):
        return np.array(self.vertices).round(6)[np.array(self.faces)]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.sets(st.sampled_from("tnmslacir#")))
def test_every_way_of_writing_gives_the_same_corners(tmp_path_factory, seed, style):
    writer = Writer(np.random.default_rng(seed), style)
    for _ in range(3):
        writer.add_box()
    path = tmp_path_factory.mktemp("obj") / "m.obj"
    path.write_text(writer.text(), newline="")
    expected = writer.corners()
    found = corners_of(path)
    assert len(found) == len(expected)
    # Corners of a face may start anywhere in the cycle: compare the centres and the areas' vectors.
    for measure in (lambda c: c.mean(axis=1), lambda c: np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])):
        a, b = measure(found).round(5), measure(expected).round(5)
        np.testing.assert_allclose(a[np.lexsort(a.T)], b[np.lexsort(b.T)], atol=1e-4)


@pytest.mark.parametrize("polygon", [3, 4, 5, 8])
def test_polygons_with_relative_indices(tmp_path, polygon):
    angle = 2 * np.pi * np.arange(polygon) / polygon
    block = "".join(f"v {np.cos(a):.9f} {np.sin(a):.9f} {{z}}\n" for a in angle)
    face = "f " + " ".join(str(k - polygon) for k in range(polygon)) + "\n"
    path = tmp_path / "two.obj"
    path.write_text(block.replace("{z}", "0") + face + block.replace("{z}", "1") + face)
    target = load_target(path)
    assert len(target.vertices_m) == 2 * polygon and len(target.faces) == 2 * (polygon - 2)
    expected = 2 * 0.5 * polygon * np.sin(2 * np.pi / polygon)
    assert target.face_areas_m2.sum() == pytest.approx(expected, rel=1e-6)


def test_a_plain_file_is_left_alone_to_the_byte():
    text = b"mtllib a.mtl\nv 0 0 -1e-3\nv 1 0 0\nv 0 1 0\nusemtl x-y\nf 1 2 3\n"
    assert plain_obj(text, "a.obj") == text


def test_a_comment_that_ends_in_a_backslash_swallows_no_line():
    text = b"# made in C:\\models\\\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 \\\n3\n"
    assert plain_obj(text, "a.obj").splitlines()[1:] == [b"v 0 0 0", b"v 1 0 0", b"v 0 1 0", b"f 1 2  3"]


@pytest.mark.parametrize("face", ["f -1 -2 -4", "f -1 -2 -0", "f -1/-1 -2/-1 -3/-1", "f -1 -x 1", "f 1/2/3/-4 1 2"])
def test_an_index_beyond_what_stands_above_is_one_sentence(tmp_path, face):
    path = tmp_path / "bad.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{face}\nv 3 3 3\n")
    with pytest.raises(MeshError, match=r"bad\.obj, line 4"):
        load_target(path)


def test_material_libraries_on_one_line_and_on_several():
    text = b"mtllib a.mtl b.mtl\nmtllib my parts.mtl\nmtllib a.mtl\n"
    assert material_libraries(text) == ["a.mtl", "b.mtl", "my parts.mtl"]
