"""STEP and IGES: converted once, in metres, and one sentence where that cannot be."""

import numpy as np
import pytest

from hat_ros.errors import MeshError, MissingDependencyError
from hat_ros.io.bag_writer import BagWriter
from hat_ros.target.loading import load_target

# As the real one is called: it writes a box, counts its calls, and dies or finds nothing when the file says so.
CONVERTER = """
import io, os, pathlib, trimesh
def load(data, file_type, tol_linear, tol_angular):
    with open(pathlib.Path(__file__).with_name("calls"), "a") as file:
        file.write(file_type + "\\n")
    if b"crash" in data:
        os.abort()
    return b"" if b"empty" in data else trimesh.Scene(trimesh.creation.box((1.0, 2.0, 3.0))).export(file_type="glb")
"""


@pytest.fixture
def converter(tmp_path, monkeypatch):
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "cascadio.py").write_text(CONVERTER)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", str(folder))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return folder


@pytest.mark.parametrize(("suffix", "kind"), [("step", "step"), ("STP", "step"), ("iges", "iges"), ("igs", "iges")])
def test_a_file_is_converted_once_and_goes_into_bags_as_glb(converter, tmp_path, suffix, kind):
    path = tmp_path / f"craft.{suffix}"
    path.write_text("ISO-10303-21;")
    (tmp_path / "target.yaml").write_text(f"mesh: craft.{suffix}\nunit_scale: auto\n")
    # The real one makes metres of STEP, but millimetres of IGES.
    extents = np.array([1, 2, 3]) * (0.001 if kind == "iges" else 1.0)
    np.testing.assert_allclose(np.ptp(load_target(tmp_path / "target.yaml").vertices_m, axis=0), extents, rtol=1e-6)
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_target(path)
    assert load_target(tmp_path / "bag" / "target.yaml").sha256 == load_target(path).sha256
    assert (tmp_path / "bag" / "craft.glb").is_file()
    assert (converter / "calls").read_text().split() == [kind]


@pytest.mark.parametrize("content", ["crash", "empty"])
def test_what_cannot_be_converted_is_one_sentence(converter, tmp_path, content):
    path = tmp_path / "bad.step"
    path.write_text(content)
    with pytest.raises(MeshError, match=r"bad\.step: OpenCASCADE finds no shape in this STEP file"):
        load_target(path)


def test_without_the_converter_the_sentence_names_it(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    path = tmp_path / "craft.step"
    path.write_text("ISO-10303-21;")
    with pytest.raises(MissingDependencyError, match=r"pip install cascadio.* export the model as glb"):
        load_target(path)


def faceted_step(extents_mm):
    """A box as a STEP file in millimetres, by hand."""
    lines = []

    def add(entity):
        lines.append(f"#{len(lines) + 1}={entity};")
        return f"#{len(lines)}"

    corners = np.array(np.meshgrid(*[(-e / 2, e / 2) for e in extents_mm], indexing="ij")).reshape(3, -1).T
    points = [add("CARTESIAN_POINT('',({:.3f},{:.3f},{:.3f}))".format(*corner)) for corner in corners]
    faces = []
    for axis, quad in ((0, "0132"), (0, "4675"), (1, "0451"), (1, "2376"), (2, "0264"), (2, "1573")):
        ids = [int(digit) for digit in quad]
        loop = add(f"POLY_LOOP('',({','.join(points[i] for i in ids)}))")
        bound = add(f"FACE_OUTER_BOUND('',{loop},.T.)")
        axes = (np.eye(3)[axis] * np.sign(corners[ids[0], axis]), np.eye(3)[(axis + 1) % 3])
        z, x = (add("DIRECTION('',({:.1f},{:.1f},{:.1f}))".format(*v)) for v in axes)
        place = add(f"AXIS2_PLACEMENT_3D('',{points[ids[0]]},{z},{x})")
        plane = add(f"PLANE('',{place})")
        faces.append(add(f"FACE_SURFACE('',({bound}),{plane},.T.)"))
    shell = add(f"CLOSED_SHELL('',({','.join(faces)}))")
    brep = add(f"FACETED_BREP('',{shell})")
    length = add("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))")
    angle = add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
    solid = add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
    context = add(
        f"(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNIT_ASSIGNED_CONTEXT(({length},{angle},{solid}))"
        f"REPRESENTATION_CONTEXT('',''))"
    )
    representation = add(f"FACETED_BREP_SHAPE_REPRESENTATION('',({brep}),{context})")
    application = add("APPLICATION_CONTEXT('automotive design')")
    product_context = add(f"PRODUCT_CONTEXT('',{application},'mechanical')")
    product = add(f"PRODUCT('box','box','',({product_context}))")
    formation = add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
    design = add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{application},'design')")
    definition = add(f"PRODUCT_DEFINITION('design','',{formation},{design})")
    shape = add(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")
    add(f"SHAPE_DEFINITION_REPRESENTATION({shape},{representation})")
    head = "FILE_DESCRIPTION((''),'2;1');\nFILE_NAME('b','2026-01-01T00:00:00',(''),(''),'','','');\n"
    return "ISO-10303-21;\nHEADER;\n{}FILE_SCHEMA(('AUTOMOTIVE_DESIGN'));\nENDSEC;\nDATA;\n{}\nENDSEC;\n{}".format(
        head, "\n".join(lines), "END-ISO-10303-21;\n"
    )


def test_a_step_file_in_millimetres_becomes_metres(tmp_path, monkeypatch):
    pytest.importorskip("cascadio", reason="the extra 'cad' is not installed")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = tmp_path / "box.step"
    path.write_text(faceted_step((2600.0, 1400.0, 900.0)))
    target = load_target(path)
    np.testing.assert_allclose(np.ptp(target.vertices_m, axis=0), [2.6, 1.4, 0.9], atol=1e-6)
    assert len(target.faces) == 12
    path.write_text("ISO-10303-21; nothing of the kind")
    with pytest.raises(MeshError, match="no shape"):
        load_target(path)
