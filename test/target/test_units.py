"""The unit of a CAD file: guessed on request, doubted when its size is that of no target."""

import pytest
import trimesh

from hat_ros.errors import MeshError
from hat_ros.target.loading import find_model, load_target
from hat_ros.target.units import UNITS


def save(path, extent):
    trimesh.creation.box((extent, 0.7 * extent, 0.4 * extent)).export(path)
    return path


def warnings_of(caplog):
    return [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]


@pytest.mark.parametrize(
    ("extent", "scale"),
    [(0.3, 1.0), (2.64, 1.0), (109.0, 1.0), (264.0, 0.01), (850.0, 0.01), (2640.0, 0.001), (27000.0, 0.001)],
)
@pytest.mark.parametrize("suffix", ["stl", "ply", "obj"])
def test_auto_takes_the_unit_that_makes_a_spacecraft(tmp_path, caplog, extent, scale, suffix):
    save(tmp_path / f"c{extent:g}.{suffix}", extent)
    (tmp_path / "target.yaml").write_text(f"mesh: c{extent:g}.{suffix}\nunit_scale: auto\n")
    target = load_target(tmp_path / "target.yaml")
    assert float(target.vertices_m.max() * 2) == pytest.approx(scale * extent, rel=1e-5)
    said = warnings_of(caplog)
    assert f"({UNITS[scale]}, {scale:g})" in said[0] and "state unit_scale as a number" in said[0]


def test_auto_leaves_a_gltf_in_metres_and_multiplies(tmp_path):
    assert find_model(save(tmp_path / "a.glb", 264.0), None).unit_scale == 1.0
    assert find_model(save(tmp_path / "a.stl", 2640.0), None).unit_scale == 0.001
    (tmp_path / "target.yaml").write_text("mesh: a.stl\nunit_scale: 0.01\n")
    assert find_model(tmp_path / "target.yaml", 0.1).unit_scale == pytest.approx(0.001)


def test_auto_without_a_fitting_unit_says_so(tmp_path, caplog):
    assert find_model(save(tmp_path / "tiny.stl", 0.02), None).unit_scale == 1.0
    assert "no spacecraft in metres, centimetres or millimetres" in warnings_of(caplog)[0]


@pytest.mark.parametrize(
    ("extent", "scale", "says"),
    [
        (264.0, 1.0, "264 m with unit_scale 1, large for a target; it would be 2.64 m in centimetres (0.01) or "
                     "0.264 m in millimetres (0.001)"),
        (100.0, 1.0, "1 m in centimetres (0.01) or 0.1 m in millimetres (0.001)"),
        (2.64, 0.001, "0.00264 m with unit_scale 0.001, small for a target; it would be 2.64 m in metres (1)"),
        (264.0, 1e-4, "or 0.264 m in millimetres (0.001)"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("suffix", ["stl", "glb"])
def test_a_size_that_few_targets_have_is_one_warning(tmp_path, caplog, extent, scale, says, suffix):
    path = save(tmp_path / f"s{extent:g}_{scale:g}_{suffix}.{suffix}", extent)
    load_target(path, scale)
    load_target(path, scale)
    assert len(warnings_of(caplog)) == 1 and says in warnings_of(caplog)[0]


@pytest.mark.parametrize(("extent", "scale"), [(0.05, 1.0), (50.0, 0.001), (2.6, 1.0), (25.0, 1.0)])
def test_usual_sizes_pass_without_a_word(tmp_path, caplog, extent, scale):
    load_target(save(tmp_path / "usual.stl", extent), scale)
    assert warnings_of(caplog) == []


def test_another_word_than_auto_is_refused(tmp_path):
    save(tmp_path / "a.stl", 1.0)
    (tmp_path / "target.yaml").write_text("mesh: a.stl\nunit_scale: mm\n")
    with pytest.raises(MeshError, match="a number or 'auto', found 'mm'"):
        load_target(tmp_path / "target.yaml")
