"""Synthetic clips: ground truth, determinism, models, mismatch, suite."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from hat_ros.bench.datasets.sequence import load_sequence
from hat_ros.bench.synth.backdrop import Earth, EarthView, Table, stars
from hat_ros.bench.synth.clips import ClipSpec, render_clip, trajectory, write_clip
from hat_ros.bench.synth.mismatch import Mismatch, apply_mismatch
from hat_ros.bench.synth.models import build_model, build_target, model_names, write_model
from hat_ros.bench.synth.suite import CLIPS, SUITE, Clip, synthesize, write_suite
from hat_ros.errors import UsageError
from hat_ros.geometry import lie
from hat_ros.io.bag_reader import BagReader
from hat_ros.target.loading import load_target
from hat_ros.target.ray_renderer import RayRenderer

SMALL = ClipSpec(frames=3, width=96, height=72, focal_px=150.0, range_m=(8.0, 6.0))


@pytest.mark.parametrize("name", model_names())
def test_models_are_metric_coloured_and_survive_a_file(tmp_path, name):
    write_model(name, tmp_path / "m.glb")
    target, direct = load_target(tmp_path / "m.glb"), build_target(name)
    assert 0.3 < target.diameter_m < 6 and len(target.faces) < 5000
    assert len(np.unique(target.face_rgb, axis=0)) > 5
    np.testing.assert_allclose(target.diameter_m, direct.diameter_m, rtol=1e-5)
    np.testing.assert_allclose(target.center_m, direct.center_m, atol=1e-5)
    assert (tmp_path / "m.glb").stat().st_size < 300_000


def half_turn_overlap(asymmetry):
    """Silhouette overlap of the observer with its half-turned self, mean over views."""
    renderer = RayRenderer(build_target("observer", asymmetry))
    camera = replace(SMALL, focal_px=200.0).camera
    out = []
    for rotvec in ([1.2, 0.3, 0.1], [1.6, -0.4, 0.8], [0.3, 1.3, 0.2]):
        R = lie.so3_exp(np.array(rotvec))
        turned = R @ np.diag([-1.0, -1.0, 1.0])
        a, b = (renderer.render(lie.transform(M, [0, 0, 6.0]), camera, color=False).mask for M in (R, turned))
        out.append((a & b).sum() / (a | b).sum())
    return np.mean(out)


def test_asymmetry_adjusts_the_ambiguity():
    overlap = [half_turn_overlap(a) for a in (0.0, 0.5, 1.0)]
    assert overlap[0] > overlap[1] > overlap[2] and overlap[0] > 0.98


def test_unknown_model_and_bad_asymmetry():
    with pytest.raises(UsageError, match="observer"):
        build_model("sputnik")
    with pytest.raises(UsageError, match="between 0 and 1"):
        build_model("observer", 1.5)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(1, 40), st.floats(-5, 5), st.floats(-2, 2))
def test_trajectory_turns_at_the_given_rate_and_reaches_the_range(frames, spin, precession):
    spec = replace(SMALL, frames=frames, spin_deg_per_frame=spin, precession_deg_per_frame=0.0)
    target = build_target("cubesat")
    poses = trajectory(spec, target)
    assert lie.is_rigid(poses).all() and poses.shape == (frames, 4, 4)
    center = poses[:, :3, :3] @ target.center_m + poses[:, :3, 3]
    assert center[0, 2] == pytest.approx(8.0) and center[-1, 2] == pytest.approx(8.0 if frames == 1 else 6.0)
    if frames > 1:
        steps = np.degrees(lie.angle_between(poses[1:, :3, :3], poses[:-1, :3, :3]))
        np.testing.assert_allclose(steps, abs(spin), atol=1e-6)
        both = trajectory(replace(spec, precession_deg_per_frame=precession), target)
        steps = np.degrees(lie.angle_between(both[1:, :3, :3], both[:-1, :3, :3]))
        assert steps.max() <= abs(spin) + abs(precession) + 1e-6


def test_clip_has_exact_truth_and_the_same_bytes_every_time(tmp_path):
    model = tmp_path / "probe.glb"
    write_model("probe", model)
    target, calls = load_target(model), []
    for name in ("a", "b"):
        write_clip(target, model, tmp_path / name, SMALL, progress=lambda *call: calls.append(call))
    assert calls[:3] == [(1, 3), (2, 3), (3, 3)]
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)
    recording = load_sequence(tmp_path / "a")
    renderer = RayRenderer(load_target(recording.target_path))
    for frame in recording.frames():
        mask = renderer.render(recording.truth()[frame.stamp_ns], recording.camera).mask
        np.testing.assert_array_equal(mask, frame.given_mask > 0)
        assert frame.rgb[mask].mean() > frame.rgb[~mask].mean() + 5
    with pytest.raises(UsageError, match="exists already"):
        write_clip(target, model, tmp_path / "a", SMALL)


@pytest.mark.parametrize(
    "change",
    [
        {"earth": Earth()},
        {"table": True, "start_rotvec": (2.2, 0.0, 0.0)},
        {"monochrome": True},
        {"star_count": 50, "noise": 0.0, "psf_px": 0.0},
        {"jpeg_quality": 0, "supersample": 1},
    ],
)
def test_every_kind_of_scene_renders(tmp_path, change):
    frames = list(render_clip(build_target("probe"), replace(SMALL, frames=2, **change)))
    assert all(f.rgb.shape == (72, 96, 3) and f.rgb.dtype == np.uint8 and f.mask.any() for f in frames)
    assert not np.array_equal(frames[0].rgb, frames[1].rgb)
    if change.get("monochrome"):
        assert (np.ptp(frames[0].rgb, axis=2) == 0).all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"frames": 0}, "frames"),
        ({"width": 1}, "width"),
        ({"range_m": (0.0, 1.0)}, "range_m"),
        ({"spin_axis": (0.0, 0.0, 0.0)}, "spin_axis"),
        ({"jpeg_quality": 101}, "jpeg_quality"),
        ({"noise": float("nan")}, "noise"),
    ],
)
def test_impossible_clips_are_refused(change, says):
    with pytest.raises(UsageError, match=says):
        replace(SMALL, **change)


def test_the_earth_moves_and_covers_what_lies_in_its_direction():
    camera = replace(SMALL, focal_px=60.0).camera
    view = EarthView(Earth(nadir_cam=(0.0, 1.0, 0.25)), camera, np.array([0.0, -1.0, -0.3]))
    assert view.covers[-1].all() and not view.covers[0].any()
    a, b = view.radiance(0.0), view.radiance(5.0)
    assert a[-1].mean() > 0.02 and not np.array_equal(a, b) and np.isfinite(a).all()


def test_the_table_stays_with_the_target():
    """A point of the table keeps its colour while the camera moves around it."""
    table, camera = Table(-0.3, 4.0, 0), replace(SMALL, focal_px=80.0).camera
    point, colors = np.array([0.2, 0.1, -0.3]), []
    for angle in (0.0, 0.2):
        R = lie.so3_exp(np.array([2.6, 0, 0])) @ lie.so3_exp(np.array([0, 0, angle]))
        t = np.array([0, 0, 3.0])
        u, v = camera.project(R @ point + t)
        t = t - np.array([(u - round(u)) * 3 / 80, (v - round(v)) * 3 / 80, 0])  # onto a pixel centre, nearly
        u, v = np.rint(camera.project(R @ point + t)).astype(int)
        colors.append(table.radiance(lie.transform(R, t), camera)[v - 1 : v + 2, u - 1 : u + 2].mean((0, 1)))
    np.testing.assert_allclose(colors[0], colors[1], atol=0.08)


def test_stray_light_fades_from_the_sun_and_is_as_bright_as_asked():
    target = build_target("probe")
    spec = ClipSpec(frames=1, width=160, height=120, focal_px=250.0, glare=0.3, exposure=0.5, noise=0.0)
    lit = next(render_clip(target, spec)).rgb.astype(int)
    plain = next(render_clip(target, replace(spec, glare=0.0))).rgb.astype(int)
    glow = (lit - plain)[18, 136:].max(axis=1)
    assert abs(glow[0] - 149) < 12  # 0.3 in sRGB
    assert (np.diff(glow) <= 0).all() and glow[-1] < 100


def test_stars_are_few_and_repeatable():
    camera = SMALL.camera
    sky = stars(camera, 1, 30)
    assert 0 < (sky > 0).any(-1).sum() <= 30
    np.testing.assert_array_equal(sky, stars(camera, 1, 30))
    assert not np.array_equal(sky, stars(camera, 2, 30))


# ---------------------------------------------------------------- mismatch


def test_no_mismatch_changes_nothing():
    target = build_target("observer")
    assert apply_mismatch(target, Mismatch()) is target


def test_turned_panels_move_and_the_bus_stays():
    target = build_target("observer")
    turned = apply_mismatch(target, Mismatch(panel_turn_deg=30))
    moved = np.linalg.norm(turned.vertices_m - target.vertices_m, axis=1)
    wing = np.abs(target.vertices_m[:, 1]) > 0.56
    assert moved[wing].max() > 0.2 and moved[~wing].max() < 1e-9
    np.testing.assert_allclose(turned.diameter_m, target.diameter_m, rtol=0.1)


def test_recoloured_spacecraft_has_the_same_shape():
    target = build_target("observer")
    other = apply_mismatch(target, Mismatch(recolor=1.0, seed=3))
    assert other.vertices_m is target.vertices_m
    assert np.abs(other.face_rgb.astype(int) - target.face_rgb).mean() > 5
    assert any(not np.array_equal(a, b) for a, b in zip(other.surface.textures, target.surface.textures, strict=True))


def test_missing_parts_are_the_small_ones():
    target = build_target("probe")
    fewer = apply_mismatch(target, Mismatch(missing=0.4))
    assert len(fewer.faces) < len(target.faces) and fewer.faces.max() == len(fewer.vertices_m) - 1
    np.testing.assert_allclose(fewer.center_m[:2], target.center_m[:2], atol=0.4)
    camera = SMALL.camera
    assert RayRenderer(fewer).render(lie.transform(np.eye(3), [0, 0, 6.0]), camera).mask.any()


@pytest.mark.parametrize("change", [{"recolor": 2.0}, {"missing": 1.0}])
def test_impossible_mismatch(change):
    with pytest.raises(UsageError, match="mismatch"):
        Mismatch(**change)


# ---------------------------------------------------------------- named clips


def test_suite_names_exist_and_rates_are_the_papers():
    assert {name for group in SUITE.values() for name in group} <= set(CLIPS)
    rates = {group: CLIPS[names[0]].spec.spin_deg_per_frame for group, names in SUITE.items()}
    assert rates == {"spark": 0.41, "shirt": 4.1, "swisscube": 1.627, "ycbv": 0.12}


@pytest.mark.parametrize("name", CLIPS)
def test_named_clips_keep_most_of_the_target_in_view(name):
    clip = CLIPS[name].within(CLIPS[name].spec.width // 5)
    target = build_target(clip.model, clip.asymmetry)
    renderer, camera = RayRenderer(target), clip.spec.camera
    poses = trajectory(clip.spec, target)
    for T in poses[:: max(1, len(poses) // 6)]:
        u, v = camera.project(T[:3, :3] @ target.center_m + T[:3, 3])
        assert 0 <= u < camera.width and 0 <= v < camera.height
        assert renderer.render(T, camera, color=False).mask.sum() > 20


def test_scaling_keeps_the_field_of_view():
    clip = CLIPS["demo"]
    half = clip.within(320).spec
    assert (half.width, half.height) == (320, 240)
    assert half.width / half.focal_px == pytest.approx(clip.spec.width / clip.spec.focal_px)


def test_a_width_limits_only_what_is_wider():
    spark, ycbv = CLIPS["spark_observer"], CLIPS["ycbv_probe"]
    assert (spark.within(720).spec.width, spark.within(720).spec.height) == (720, 540)
    assert ycbv.within(720).spec == ycbv.spec
    assert spark.within(None) == spark


def test_suite_is_written_as_bags_and_resumed(tmp_path):
    bags = write_suite(tmp_path / "suite", width_px=96, limit=2)
    assert [bag.name for bag in bags] == [name for names in SUITE.values() for name in names]
    before = [bag.stat().st_mtime_ns for bag in bags]
    again = write_suite(tmp_path / "suite", width_px=96, limit=2)
    assert [bag.stat().st_mtime_ns for bag in again] == before
    reader = BagReader(bags[-1])
    assert len(reader) == 2 and len(reader.truth()) == 2 and reader.has_masks


def test_a_mismatched_clip_ships_the_nominal_model(tmp_path):
    clip = Clip("observer", SMALL, mismatch=Mismatch(panel_turn_deg=60))
    folder = synthesize(clip, tmp_path / "clip", as_bag=False)
    recording = load_sequence(folder)
    target = load_target(recording.target_path)
    assert target.diameter_m == pytest.approx(build_target("observer").diameter_m, rel=1e-5)
    frame = next(iter(recording.frames()))
    nominal = RayRenderer(target).render(recording.truth()[frame.stamp_ns], recording.camera).mask
    assert (nominal != (frame.given_mask > 0)).sum() > 20
    with pytest.raises(UsageError, match="exists already"):
        synthesize(clip, tmp_path / "clip")
    assert not list(tmp_path.glob("*.work"))


@pytest.mark.parametrize("as_bag", [True, False])
@pytest.mark.parametrize("scale", ["0.001", "auto"])
def test_a_target_yaml_in_millimetres_is_filmed_with_its_colours(tmp_path, as_bag, scale):
    folder = tmp_path / "cad"
    folder.mkdir()
    (folder / "m.mtl").write_text("newmtl red\nKd 1 0 0\n")
    box = trimesh.creation.box((2600, 1400, 900))
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices] + [f"f {a} {b} {c}" for a, b, c in box.faces + 1]
    (folder / "craft.obj").write_text("mtllib m.mtl\nusemtl red\n" + "\n".join(lines) + "\n")
    (folder / "target.yaml").write_text(f"mesh: craft.obj\nunit_scale: {scale}\n")
    out = synthesize(Clip(str(folder / "target.yaml"), SMALL), tmp_path / "out", as_bag)
    if as_bag:
        target = load_target(out / "target.yaml")
    else:
        recording = load_sequence(out)
        target = load_target(recording.target_path, recording.unit_scale)
    assert np.ptp(target.vertices_m, axis=0) == pytest.approx([2.6, 1.4, 0.9])
    assert (target.face_rgb == (255, 0, 0)).all()
