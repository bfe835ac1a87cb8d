"""Each data set's layout, made tiny here, read back and written to bags; and what malformed ones get."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
import trimesh

from hat_ros.bench.datasets import spark
from hat_ros.bench.datasets.bop import open_bop
from hat_ros.bench.datasets.image_files import camera_from_label, stamp_of
from hat_ros.bench.datasets.importer import (
    IMPORT_FILE,
    check_picture,
    import_dataset,
    open_dataset,
    with_annotation_boxes,
)
from hat_ros.bench.datasets.protocols import PROTOCOLS
from hat_ros.bench.datasets.sequence import load_sequence, write_labels
from hat_ros.bench.experiments.comparison import clips_of_dataset
from hat_ros.bench.source import SourceSpec
from hat_ros.config import load_config
from hat_ros.errors import BagError, DatasetError, MeshError, UsageError
from hat_ros.geometry import lie
from hat_ros.io.bag_reader import BagReader
from hat_ros.target.exact_symmetry import symmetry_of
from hat_ros.target.loading import load_target
from hat_ros.types import Camera

K = np.array([[300.0, 0.0, 79.0], [0.0, 310.0, 60.0], [0.0, 0.0, 1.0]])
CAMERA = Camera(K, 160, 120)
POSES = lie.transform(
    lie.so3_exp(np.array([[0.1, 0.2, 0.3], [0.2, 0.3, 0.4], [3.0, 0.1, 0.0]])),
    np.array([[0.1, 0.0, 5.0], [0.0, 0.1, 5.5], [-0.1, 0.05, 6.0]]),
)


def image(index, camera=CAMERA):
    """A picture that differs from frame to frame, smooth so that JPEG keeps it."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([u % 256, v % 256, np.full_like(u, 40 * index)], axis=-1).astype(np.uint8)


def save(path, picture):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture[..., ::-1] if picture.ndim == 3 else picture)


def save_mesh(path, extents=(1.0, 0.6, 0.3)):
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(extents).export(path)
    return path


def wxyz(T):
    return lie.quat_from_matrix(T[:3, :3])[[3, 0, 1, 2]].tolist()


@pytest.fixture
def sequence(tmp_path):
    root = tmp_path / "clip"
    save_mesh(root / "target.ply")
    names = [f"{i:06d}.jpg" for i in range(3)]
    for index, name in enumerate(names):
        save(root / "images" / name, image(index))
        mask = np.zeros((120, 160), np.uint8)
        mask[10 : 20 + index, 30:50] = 255
        save(root / "masks" / f"{index:06d}.png", mask)
    write_labels(root, CAMERA, "target.ply", "test", POSES, names)
    return root


@pytest.fixture
def spark_root(tmp_path):
    root = tmp_path / "spark"
    with_header = [["sequence", "filename", "Tx", "Ty", "Tz", "Qx", "Qy", "Qz", "Qw"]]
    camera = camera_from_label(spark.K, spark.SIZE, "spark")
    for name in ("RT500", "RT501"):
        for index, T in enumerate(POSES):
            save(root / "images" / name / f"img{index:03d}.jpg", image(index, camera))
            q = lie.quat_from_matrix(T[:3, :3])
            with_header.append([name, f"img{index:03d}.jpg", *T[:3, 3], *q])
    with (root / "labels.csv").open("w", newline="") as file:
        csv.writer(file).writerows(with_header)
    return root


@pytest.fixture
def shirt_root(tmp_path):
    root = tmp_path / "shirt"
    root.mkdir()
    calibration = {"cameraMatrix": K.tolist(), "distCoeffs": [-0.6, 0.1, 0.001, 0.0, 0.0], "Nu": 160, "Nv": 120}
    (root / "camera.json").write_text(json.dumps(calibration))
    for roe in ("roe1", "roe2"):
        labels = []
        for index, T in enumerate(POSES):
            name = f"img{index:06d}.jpg"
            for domain in ("synthetic", "lightbox"):
                save(root / roe / domain / "images" / name, image(index))
            labels.append({"filename": name, "q_vbs2tango_true": wxyz(T), "r_Vo2To_vbs_true": T[:3, 3].tolist()})
        (root / roe / f"{roe}.json").write_text(json.dumps(labels))
    return root


def write_scene(scene, object_ids=(1,), suffix="png"):
    gt, calibration = {}, {}
    for index, T in enumerate(POSES):
        save(scene / "rgb" / f"{index:06d}.{suffix}", image(index))
        entries = []
        for slot, object_id in enumerate(object_ids):
            shifted = T.copy()
            shifted[0, 3] += 0.5 * slot
            entries.append(
                {
                    "cam_R_m2c": T[:3, :3].ravel().tolist(),
                    "cam_t_m2c": (1e3 * shifted[:3, 3]).tolist(),
                    "obj_id": object_id,
                }
            )
            mask = np.zeros((120, 160), np.uint8)
            mask[10 * (slot + 1) :, :] = 255
            save(scene / "mask_visib" / f"{index:06d}_{slot:06d}.png", mask)
        gt[str(index)] = entries
        calibration[str(index)] = {"cam_K": K.ravel().tolist(), "depth_scale": 1.0}
    (scene / "scene_gt.json").write_text(json.dumps(gt))
    (scene / "scene_camera.json").write_text(json.dumps(calibration))


@pytest.fixture
def bop_root(tmp_path):
    root = tmp_path / "ycbv"
    write_scene(root / "test" / "000048", object_ids=(5, 2))
    for object_id in (2, 5):
        save_mesh(root / "models" / f"obj_{object_id:06d}.ply", (100, 60, 30))
    (root / "test_targets_bop19.json").write_text(
        json.dumps([{"scene_id": 48, "im_id": 1, "obj_id": 5, "inst_count": 1}])
    )
    return root


# ---------------------------------------------------------------- sequence


def test_sequence_gives_frames_masks_truth_and_stamps(sequence):
    recording = load_sequence(sequence)
    frames = list(recording.frames())
    assert len(recording) == 3 and [f.stamp_ns for f in frames] == [stamp_of(i) for i in range(3)]
    assert frames[0].stamp_ns > 0 and frames[1].stamp_ns - frames[0].stamp_ns == 100_000_000
    assert frames[1].given_mask.max() == 255 and (frames[1].given_mask > 0).sum() == 11 * 20
    assert np.abs(frames[2].rgb.astype(int) - image(2)).mean() < 3
    truth = recording.truth()
    np.testing.assert_allclose([truth[f.stamp_ns] for f in frames], POSES, atol=1e-12)
    assert len(list(recording.frames(2))) == 2


def test_sequence_becomes_a_bag_with_the_same_image_bytes(sequence, tmp_path):
    (bag,) = import_dataset("sequence", sequence, tmp_path / "bag", check=True)
    reader = BagReader(bag)
    for index, (packet, frame, source) in enumerate(
        zip(reader.packets(), reader.frames(), load_sequence(sequence).frames(), strict=True)
    ):
        assert (sequence / "images" / f"{index:06d}.jpg").read_bytes() in packet.image
        np.testing.assert_array_equal(frame.rgb, source.rgb)
        np.testing.assert_array_equal(frame.given_mask, source.given_mask)
        assert frame.stamp_ns == source.stamp_ns
    np.testing.assert_allclose(list(reader.truth().values()), POSES, atol=1e-12)
    np.testing.assert_array_equal(reader.camera.K, K)
    assert load_target(reader.target_path).sha256 == load_target(sequence / "target.ply").sha256
    assert (tmp_path / "bag.check.png").is_file()
    assert not (tmp_path / "bag.partial").exists()


def test_complete_bags_are_left_alone_and_interrupted_ones_redone(spark_root, tmp_path):
    model, out = save_mesh(tmp_path / "cad.ply"), tmp_path / "bags"

    class Stop(Exception):
        pass

    def stop_in_second(name, done, total):
        if name == "RT501" and done == 2:
            raise Stop

    with pytest.raises(Stop):
        import_dataset("spark", spark_root, out, model=model, progress=stop_in_second)
    assert (out / "RT500" / "metadata.yaml").is_file() and not (out / "RT501").exists()
    before = (out / "RT500" / "manifest.json").stat().st_mtime_ns
    calls = []
    bags = import_dataset("spark", spark_root, out, model=model, progress=lambda *call: calls.append(call))
    assert [bag.name for bag in bags] == ["RT500", "RT501"]
    assert (out / "RT500" / "manifest.json").stat().st_mtime_ns == before
    assert calls[0] == ("RT500", 3, 3) and calls[-1] == ("RT501", 3, 3)
    assert len(BagReader(out / "RT501")) == 3 and not list(out.glob("*.partial"))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda labels: labels.update(frames=[]), "non-empty list"),
        (lambda labels: labels.update(K=[[1, 2], [3, 4]]), "'K' must be 3x3"),
        (lambda labels: labels.update(size=[160]), "'size'"),
        (lambda labels: labels.update(mesh="gone.ply"), "not in the folder"),
        (lambda labels: labels.update(scale="big"), "'scale' must be a number"),
        (lambda labels: labels["frames"][1].pop("file"), "frame 1: expected a mapping with 'file'"),
        (lambda labels: labels["frames"][1].update(file="x.jpg"), "frame 1: image 'x.jpg'"),
        (lambda labels: labels["frames"][2].update(q_wxyz_cam_from_target=[1, 1, 1, 1]), "quaternion has length 2"),
        (lambda labels: labels["frames"][2].update(t_cam_from_target_m=[0, 0]), "3 finite numbers"),
        (lambda labels: labels["frames"][2].update(t_cam_from_target_m=["a", 0, 1]), "not made of numbers"),
        (lambda labels: labels["frames"][2].update(t_cam_from_target_m=[10**400, 0, 1]), "not made of numbers"),
        (lambda labels: labels["frames"][1].update(file="x" * 256), "too long for the name of a file"),
        (lambda labels: labels["frames"][1].update(file="x/" * 2500), "too long for the name of a file"),
        (lambda labels: labels.update(mesh="x/" * 2500 + "cad.ply"), "too long for the name of a file"),
    ],
)
def test_malformed_sequence_labels(sequence, change, says):
    labels = json.loads((sequence / "labels.json").read_text())
    change(labels)
    (sequence / "labels.json").write_text(json.dumps(labels))
    with pytest.raises(DatasetError, match=says):
        load_sequence(sequence)


def test_sequence_without_labels_or_with_broken_json(sequence):
    (sequence / "labels.json").write_text("{")
    with pytest.raises(DatasetError, match="not valid JSON"):
        load_sequence(sequence)
    (sequence / "labels.json").unlink()
    with pytest.raises(DatasetError, match="cannot be read"):
        load_sequence(sequence)


def test_images_that_cannot_be_decoded_or_have_another_size(sequence):
    save(sequence / "images" / "000001.jpg", image(0)[:50])
    with pytest.raises(DatasetError, match="160x50, the calibration says 160x120"):
        list(load_sequence(sequence).frames())
    (sequence / "images" / "000001.jpg").write_bytes(b"no image")
    with pytest.raises(DatasetError, match="not an image"):
        list(load_sequence(sequence).frames())


# ---------------------------------------------------------------- spark


def test_spark_poses_are_scalar_last_and_the_image_centre_is_the_principal_point(spark_root, tmp_path):
    recordings = list(open_dataset("spark", spark_root, save_mesh(tmp_path / "cad.ply")))
    assert [r.name for r in recordings] == ["RT500", "RT501"]
    np.testing.assert_allclose(list(recordings[0].truth().values()), POSES, atol=1e-9)
    np.testing.assert_allclose(recordings[0].camera.K[:2, 2], [719.5, 539.5])
    frame = next(iter(recordings[0].frames()))
    assert frame.rgb.shape == (1080, 1440, 3) and frame.given_mask is None


def test_one_spark_sequence(spark_root, tmp_path):
    model = save_mesh(tmp_path / "cad.ply")
    assert [r.name for r in open_dataset("spark", spark_root, model, ["RT501"])] == ["RT501"]
    with pytest.raises(DatasetError, match="no sequence named RT999"):
        list(open_dataset("spark", spark_root, model, ["RT999"]))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("Qw", "Q4", "column 'qw' is missing"),
        ("img001.jpg", "img009.jpg", "does not exist"),
        ("RT500,img001.jpg,", "RT500,img001.jpg,7,", "10 values for 9 columns"),
        ("RT500,img001.jpg,0.0,", "RT500,img001.jpg,far,", "not made of numbers"),
    ],
)
def test_malformed_spark_csv(spark_root, tmp_path, old, new, says):
    path = spark_root / "labels.csv"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(DatasetError, match=says):
        list(open_dataset("spark", spark_root, save_mesh(tmp_path / "cad.ply")))


def test_spark_needs_a_model_and_a_csv(spark_root, tmp_path):
    with pytest.raises(DatasetError, match="--model"):
        list(open_dataset("spark", spark_root))
    (spark_root / "labels.csv").unlink()
    with pytest.raises(DatasetError, match="expected a CSV"):
        list(open_dataset("spark", spark_root, save_mesh(tmp_path / "cad.ply")))


def test_several_spark_csvs_are_read_together_and_may_not_contradict_each_other(spark_root, tmp_path):
    model = save_mesh(tmp_path / "cad.ply")
    header, *rows = (spark_root / "labels.csv").read_text().splitlines()
    (spark_root / "labels.csv").write_text("\n".join([header, *(row for row in rows if "RT501" not in row)]))
    (spark_root / "more.csv").write_text("\n".join([header, *rows]))
    (spark_root / "notes.csv").write_text("who,when\nme,today\n")
    recordings = list(open_dataset("spark", spark_root, model))
    assert [(r.name, len(r)) for r in recordings] == [("RT500", 3), ("RT501", 3)]
    changed = rows[0].replace(rows[0].split(",")[4], "99.0", 1)
    (spark_root / "more.csv").write_text("\n".join([header, changed]))
    with pytest.raises(DatasetError, match="has another pose in"):
        list(open_dataset("spark", spark_root, model))


# ---------------------------------------------------------------- published protocols


def published(dataset, root, sequence, model=None):
    return SourceSpec(root, dataset, sequence, model, published=True).open().recording


def test_the_published_split_of_spark_alone_whatever_else_the_csv_lists(spark_root, tmp_path):
    model = save_mesh(tmp_path / "cad.ply")
    path = spark_root / "labels.csv"
    header, *rows = path.read_text().splitlines()
    beyond = [row.replace("RT501", "RT600") for row in rows if "RT501" in row]
    path.write_text("\n".join([header, *(row for row in rows if "RT501" not in row), *beyond]))
    clips = clips_of_dataset("spark", spark_root, model, [], published=True)
    assert [spec.name for spec, _ in clips] == ["RT500"]
    path.write_text("\n".join([header, *beyond]))
    with pytest.raises(DatasetError, match=r"published split.*--protocol none"):
        clips_of_dataset("spark", spark_root, model, [], published=True)


def test_published_shirt_keeps_the_lens_and_boxes_the_corners_of_the_cad_model(shirt_root, tmp_path):
    cad = tmp_path / "cad.ply"
    trimesh.creation.icosphere(radius=0.4).export(cad)
    recording = published("shirt", shirt_root, "roe1_synthetic", cad)
    usual = SourceSpec(shirt_root, "shirt", "roe1_synthetic", cad).open().recording
    assert usual.distortion.any() and not recording.distortion.any()
    item, T = recording.files[1], recording.files[1].T_cam_target
    vertices = load_target(cad).vertices_m
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * vertices.max(axis=0)
    uv = recording.camera.project(corners @ T[:3, :3].T + T[:3, 3])
    np.testing.assert_allclose(item.box_xyxy, np.concatenate([uv.min(axis=0), uv.max(axis=0)]), atol=1e-6)


def test_published_ycbv_asks_for_poses_at_the_targets_alone(bop_root):
    source = SourceSpec(bop_root, "ycbv", "000048_obj5", published=True).open()
    assert [frame.scored for frame in source.frames()] == [False, True, False]
    assert [frame.stamp_ns for frame in source.frames(scored_only=True)] == [stamp_of(1)]
    plain = SourceSpec(bop_root, "ycbv", "000048_obj5").open()
    assert all(frame.scored for frame in plain.frames())


@pytest.mark.parametrize("preset", ["mega_hat", "pico_hat", "default"])
@pytest.mark.parametrize("dataset", PROTOCOLS)
def test_the_settings_of_every_profile_fit_every_preset(dataset, preset):
    config = load_config(preset, PROTOCOLS[dataset].settings)
    assert config.slam.masked == (dataset in ("spark", "swisscube"))
    assert config.segmentation.pose_region == ("box" if dataset == "swisscube" else "detection")


def test_a_cad_model_with_other_axes_than_the_labels_is_turned_into_theirs(sequence, tmp_path):
    T_label_cad = lie.transform(lie.so3_exp(np.array([np.pi / 2, 0, 0.08])), np.array([0.0, 0.03, -0.046]))
    labels = json.loads((sequence / "labels.json").read_text())
    upright = load_target(sequence / labels["mesh"]).vertices_m
    cad = trimesh.load(sequence / labels["mesh"], force="mesh")
    cad.apply_transform(np.linalg.inv(T_label_cad))
    cad.apply_scale(1000.0)
    cad.export(tmp_path / "turned.ply")
    stated = {"mesh": "turned.ply", "unit_scale": 0.001, "T_label_cad": T_label_cad.tolist()}
    (tmp_path / "target.yaml").write_text(json.dumps(stated))
    found = load_target(tmp_path / "target.yaml").vertices_m
    np.testing.assert_allclose(found[np.lexsort(found.round(5).T)], upright[np.lexsort(upright.round(5).T)], atol=1e-6)
    recording = replace(load_sequence(sequence), target_path=tmp_path / "target.yaml")
    with_axes = check_picture(recording)
    (tmp_path / "target.yaml").write_text(json.dumps(stated | {"T_label_cad": np.eye(4).tolist()}))
    assert (with_axes != check_picture(recording)).any()
    (tmp_path / "target.yaml").write_text(json.dumps(stated | {"T_label_cad": [[2, 0], [0, 1]]}))
    with pytest.raises(MeshError, match="T_label_cad must be four rows"):
        load_target(tmp_path / "target.yaml")


# ---------------------------------------------------------------- shirt


def test_shirt_has_four_recordings_with_scalar_first_poses(shirt_root, tmp_path):
    recordings = list(open_dataset("shirt", shirt_root, save_mesh(tmp_path / "cad.ply")))
    assert [r.name for r in recordings] == ["roe1_synthetic", "roe1_lightbox", "roe2_synthetic", "roe2_lightbox"]
    np.testing.assert_allclose(list(recordings[2].truth().values()), POSES, atol=1e-12)


def test_shirt_images_are_undistorted_with_the_same_camera(shirt_root, tmp_path):
    """A dot drawn where the lens puts a point must come out where the pinhole puts it."""
    point = np.array([[0.35, -0.25, 2.0]])
    coefficients = np.array(json.loads((shirt_root / "camera.json").read_text())["distCoeffs"])
    seen = cv2.projectPoints(point, np.zeros(3), np.zeros(3), K, coefficients)[0].ravel()
    picture = np.zeros((120, 160), np.uint8)
    cv2.circle(picture, tuple(np.rint(seen * 16).astype(int).tolist()), 3 * 16, 255, -1, cv2.LINE_AA, shift=4)
    save(shirt_root / "roe1" / "synthetic" / "images" / "img000000.jpg", picture)
    recording = next(iter(open_dataset("shirt", shirt_root, save_mesh(tmp_path / "cad.ply"))))
    frame = next(iter(recording.frames()))
    weight = frame.rgb[..., 0].astype(float) * (frame.rgb[..., 0] > 60)
    v, u = np.mgrid[:120, :160]
    found = np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()
    expected = CAMERA.project(point[0])
    assert np.abs(expected - seen).max() > 1.0
    np.testing.assert_allclose(found, expected, atol=0.15)


def test_undistorted_images_are_stored_without_loss(shirt_root, tmp_path):
    model = save_mesh(tmp_path / "cad.ply")
    (bag,) = import_dataset("shirt", shirt_root, tmp_path / "out", model=model, sequences=["roe2_lightbox"], boxes=True)
    source = next(iter(open_dataset("shirt", shirt_root, model, ["roe2_lightbox"])))
    for frame, expected in zip(BagReader(bag).frames(), source.frames(), strict=True):
        np.testing.assert_array_equal(frame.rgb, expected.rgb)
        assert set(np.unique(frame.given_mask)) == {0, 128}


def test_annotation_boxes_hold_the_projected_model(shirt_root, tmp_path):
    recording = next(iter(open_dataset("shirt", shirt_root, save_mesh(tmp_path / "cad.ply"))))
    boxed = with_annotation_boxes(recording)
    vertices = load_target(boxed.target_path).vertices_m
    for item in boxed.files:
        T = item.T_cam_target
        uv = CAMERA.project(vertices @ T[:3, :3].T + T[:3, 3])
        rows, cols = np.nonzero(boxed.given_mask(item))
        assert abs(cols.min() - uv[:, 0].min()) <= 1 and abs(rows.max() - uv[:, 1].max()) <= 1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"distCoeffs": [1, 2]}, "distCoeffs must be 4"),
        ({"distCoeffs": "none"}, "list of numbers"),
        ({"Nu": None}, "image size expected"),
        ({"cameraMatrix": [1, 2, 3]}, "camera matrix"),
    ],
)
def test_malformed_shirt_calibration(shirt_root, tmp_path, change, says):
    path = shirt_root / "camera.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(DatasetError, match=says):
        list(open_dataset("shirt", shirt_root, save_mesh(tmp_path / "cad.ply")))


def test_shirt_with_missing_image_label_or_folder(shirt_root, tmp_path):
    model = save_mesh(tmp_path / "cad.ply")
    (shirt_root / "roe1" / "synthetic" / "images" / "img000002.jpg").unlink()
    with pytest.raises(DatasetError, match="entry 2: image"):
        list(open_dataset("shirt", shirt_root, model))
    (shirt_root / "roe1" / "roe1.json").write_text("[]")
    with pytest.raises(DatasetError, match="non-empty list"):
        list(open_dataset("shirt", shirt_root, model))
    with pytest.raises(DatasetError, match=r"camera\.json"):
        list(open_dataset("shirt", tmp_path, model))


# ---------------------------------------------------------------- swisscube


@pytest.mark.parametrize("inner", ["000000", ""])
def test_swisscube_in_both_layouts(tmp_path, inner):
    root = tmp_path / "swisscube"
    write_scene(root / "testing" / "seq_000400" / inner, suffix="jpg")
    save_mesh(root / "models" / "obj_000001.ply", (100, 60, 30))
    (recording,) = open_dataset("swisscube", root)
    assert recording.name == "seq_000400" and recording.unit_scale == pytest.approx(1e-3)
    np.testing.assert_allclose(list(recording.truth().values()), POSES, atol=1e-9)
    assert [(f.given_mask > 0).sum() for f in recording.frames()] == [110 * 160] * 3
    (bag,) = import_dataset("swisscube", root, tmp_path / "bags")
    target = load_target(BagReader(bag).target_path)
    np.testing.assert_allclose(np.ptp(target.vertices_m, axis=0), [0.1, 0.06, 0.03], atol=1e-6)


def test_swisscube_folders(tmp_path):
    with pytest.raises(DatasetError, match="seq_"):
        list(open_dataset("swisscube", tmp_path))
    write_scene(tmp_path / "testing" / "seq_000400")
    with pytest.raises(DatasetError, match="--model"):
        list(open_dataset("swisscube", tmp_path))


# ---------------------------------------------------------------- bop


HALF_TURN_MM = [-1, 0, 0, 100, 0, -1, 0, 60, 0, 0, 1, 0, 0, 0, 0, 1]


def test_bop_symmetries_in_millimetres_become_metres_in_the_bag(bop_root, tmp_path):
    info = {"2": {"diameter": 120, "symmetries_discrete": [HALF_TURN_MM]}, "5": {"diameter": 120}}
    (bop_root / "models" / "models_info.json").write_text(json.dumps(info))
    bags = {bag.name: bag for bag in import_dataset("bop", bop_root, tmp_path / "bags")}
    target = load_target(BagReader(bags["000048_obj2"]).target_path)
    np.testing.assert_allclose(symmetry_of(target).turns[1][:3, 3], [0.1, 0.06, 0.0])
    assert load_target(BagReader(bags["000048_obj5"]).target_path).declared_symmetry is None
    spec = SourceSpec(bop_root, "bop", "000048_obj2")
    np.testing.assert_array_equal(symmetry_of(spec.open().target).turns, symmetry_of(target).turns)
    stamp = bags["000048_obj2"].stat().st_mtime_ns
    import_dataset("bop", bop_root, tmp_path / "bags")
    assert bags["000048_obj2"].stat().st_mtime_ns == stamp, "complete: left alone"
    (bop_root / "models" / "models_info.json").write_text(json.dumps({"2": {"symmetries_discrete": []}}))
    import_dataset("bop", bop_root, tmp_path / "bags")
    assert symmetry_of(load_target(BagReader(bags["000048_obj2"]).target_path)).is_trivial


def test_a_bop_symmetry_that_is_none_is_one_sentence(bop_root):
    info = {"2": {"symmetries_continuous": [{"axis": [0, 0, 1]}]}}
    (bop_root / "models" / "models_info.json").write_text(json.dumps(info))
    with pytest.raises(DatasetError, match=r"models_info.json, object 2: symmetries_continuous\[0\] must have 'axis'"):
        list(open_dataset("bop", bop_root))


def test_bop_gives_one_recording_per_object_with_its_own_mask(bop_root):
    recordings = {r.name: r for r in open_dataset("bop", bop_root)}
    assert sorted(recordings) == ["000048_obj2", "000048_obj5"]
    shifted = POSES.copy()
    shifted[:, 0, 3] += 0.5
    np.testing.assert_allclose(list(recordings["000048_obj5"].truth().values()), POSES, atol=1e-9)
    np.testing.assert_allclose(list(recordings["000048_obj2"].truth().values()), shifted, atol=1e-9)
    frame = next(iter(recordings["000048_obj2"].frames()))
    assert (frame.given_mask > 0).sum() == 100 * 160
    assert load_target(recordings["000048_obj2"].target_path, 1e-3).diameter_m == pytest.approx(0.12, abs=0.01)


def test_bop_truth_can_be_kept_at_the_published_targets_only(bop_root):
    recordings = {r.name: r for r in open_bop(bop_root, targets_only=True)}
    assert list(recordings["000048_obj5"].truth()) == [stamp_of(1)]
    assert recordings["000048_obj2"].truth() == {} and len(recordings["000048_obj2"]) == 3


def test_ycbv_is_scored_at_the_targets_of_objects_without_symmetry(bop_root):
    (recording,) = open_dataset("ycbv", bop_root)
    assert recording.name == "000048_obj5", "the other object has no target"
    assert list(recording.truth()) == [stamp_of(1)] and len(recording) == 3
    ground_truth = bop_root / "test" / "000048" / "scene_gt.json"
    ground_truth.write_text(ground_truth.read_text().replace('"obj_id": 5', '"obj_id": 13'))
    targets = bop_root / "test_targets_bop19.json"
    targets.write_text(targets.read_text().replace('"obj_id": 5', '"obj_id": 13'))
    with pytest.raises(DatasetError, match="no sequence"):
        list(open_dataset("ycbv", bop_root))


@pytest.mark.parametrize(
    ("file", "change", "says"),
    [
        ("scene_gt.json", lambda d: d["1"][0].pop("obj_id"), "obj_id"),
        ("scene_gt.json", lambda d: d["1"][0].update(cam_R_m2c=[1] * 9), "not a rotation"),
        ("scene_gt.json", lambda d: d["1"][0].update(cam_t_m2c=[1]), "cam_t_m2c"),
        ("scene_camera.json", lambda d: d.pop("2"), "image 2 has no cam_K"),
        ("scene_camera.json", lambda d: d["2"]["cam_K"].__setitem__(0, 400), "cam_K changes"),
    ],
)
def test_malformed_bop_scene(bop_root, file, change, says):
    path = bop_root / "test" / "000048" / file
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(DatasetError, match=says):
        list(open_dataset("bop", bop_root))


def test_bop_without_models_scenes_or_images(bop_root, tmp_path):
    (bop_root / "models" / "obj_000002.ply").unlink()
    with pytest.raises(DatasetError, match="object 2"):
        list(open_dataset("bop", bop_root))
    with pytest.raises(DatasetError, match="models come with"):
        list(open_dataset("bop", bop_root, save_mesh(tmp_path / "cad.ply")))
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match="no scene"):
        list(open_dataset("bop", tmp_path / "empty"))


# ---------------------------------------------------------------- common


def test_unknown_format_folder_and_model(tmp_path):
    with pytest.raises(UsageError, match="choose one of"):
        list(open_dataset("kitti", tmp_path))
    with pytest.raises(DatasetError, match="no such folder"):
        list(open_dataset("spark", tmp_path / "gone"))
    with pytest.raises(DatasetError, match="CAD model"):
        list(open_dataset("spark", tmp_path, tmp_path / "gone.ply"))


def test_a_bad_model_is_found_before_anything_is_written(sequence, tmp_path):
    (sequence / "target.ply").write_bytes(b"ply nonsense")
    with pytest.raises(MeshError):
        import_dataset("sequence", sequence, tmp_path / "bag")
    assert not (tmp_path / "bag").exists() and not (tmp_path / "bag.partial").exists()


def test_a_folder_that_is_no_bag_is_not_overwritten(sequence, tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "thesis.tex").write_text("dear")
    with pytest.raises(UsageError, match="not a bag"):
        import_dataset("sequence", sequence, tmp_path / "bag")
    assert (tmp_path / "bag" / "thesis.tex").is_file()


def test_check_picture_draws_the_outline_and_needs_truth(sequence):
    recording = load_sequence(sequence)
    picture = check_picture(recording, width_px=160)
    assert picture.shape == (240, 480, 3)
    assert ((picture == [0, 255, 0]).all(-1)).sum() > 50
    unlabelled = replace(recording, files=[replace(item, T_cam_target=None) for item in recording.files])
    with pytest.raises(DatasetError, match="nothing to check"):
        check_picture(unlabelled)


@pytest.mark.parametrize(("cx", "expected"), [(80.0, 79.5), (79.5, 79.5), (81.0, 81.0)])
def test_principal_point_counted_from_the_corner_is_moved_to_pixel_centres(cx, expected):
    matrix = K.copy()
    matrix[:2, 2] = cx, 60.0
    assert camera_from_label(matrix, (160, 120), "test").K[0, 2] == expected


# ---------------------------------------------------------------- detections computed elsewhere


def rle_of(mask):
    """COCO run lengths from their definition: columns, background first."""
    flat = mask.T.ravel().astype(np.int8)
    changes = np.flatnonzero(np.diff(np.concatenate([[0], flat])))
    counts = np.diff(np.concatenate([[0], changes, [flat.size]])).tolist()
    return {"size": list(mask.shape), "counts": counts}


def spot(row, height=120, width=160):
    mask = np.zeros((height, width), bool)
    mask[row : row + 10, 50:90] = True
    return mask


def cnos(image_id, mask, **more):
    return {"image_id": image_id, "score": 0.5, "segmentation": rle_of(mask), "bbox": [0, 0, 1, 1], **more}


def write_json(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data))
    return path


def given_masks(bag):
    return [frame.given_mask for frame in BagReader(bag).frames()]


def test_cnos_detections_take_the_place_of_a_sequences_masks(sequence, tmp_path):
    path = write_json(tmp_path / "cnos.json", [cnos(0, spot(20)), cnos(2, spot(40)), cnos(2, spot(60), score=0.1)])
    (bag,) = import_dataset("sequence", sequence, tmp_path / "bag", detections=path)
    first, second, third = given_masks(bag)
    np.testing.assert_array_equal(first == 255, spot(20))
    assert second is None, "no detection there, and the recording's own mask does not step in"
    np.testing.assert_array_equal(third == 255, spot(40))


def test_boxes_by_file_name(sequence, tmp_path):
    path = write_json(tmp_path / "boxes.json", {"000001.jpg": [50, 20, 90, 30]})
    (bag,) = import_dataset("sequence", sequence, tmp_path / "bag", detections=path)
    assert [mask is None for mask in given_masks(bag)] == [True, False, True]
    np.testing.assert_array_equal(given_masks(bag)[1], 128 * spot(20).astype(np.uint8))


def test_each_sequence_has_a_folder_or_file_of_its_own(spark_root, tmp_path):
    model, height, width = save_mesh(tmp_path / "cad.ply"), spark.SIZE[1], spark.SIZE[0]
    folder = tmp_path / "detections"
    save(folder / "RT500" / "img001.png", 255 * spot(5, height, width).astype(np.uint8))
    write_json(folder / "RT501.json", [cnos("img002.jpg", spot(7, height, width))])
    bags = import_dataset("spark", spark_root, tmp_path / "bags", model=model, detections=folder)
    found = {bag.name: [None if m is None else int(np.argmax(m[:, 60])) for m in given_masks(bag)] for bag in bags}
    assert found == {"RT500": [None, 5, None], "RT501": [None, None, 7]}


def test_one_file_for_several_sequences_is_refused_unless_one_is_named(spark_root, tmp_path):
    model = save_mesh(tmp_path / "cad.ply")
    path = write_json(tmp_path / "cnos.json", [cnos("img000.jpg", spot(5, spark.SIZE[1], spark.SIZE[0]))])
    with pytest.raises(UsageError, match=r"neither RT500 nor RT500\.json.*--sequence"):
        import_dataset("spark", spark_root, tmp_path / "bags", model=model, detections=path)
    (bag,) = import_dataset("spark", spark_root, tmp_path / "bags", model=model, sequences=["RT501"], detections=path)
    assert [mask is None for mask in given_masks(bag)] == [False, True, True]


def test_bop_detections_are_told_apart_by_scene_and_object(bop_root, tmp_path):
    items = [
        cnos(0, spot(10), scene_id=48, category_id=5),
        cnos(0, spot(30), scene_id=48, category_id=2, score=0.9),
        cnos(0, spot(50), scene_id=49, category_id=5, score=1.0),
    ]
    path = write_json(tmp_path / "cnos.json", items)
    bags = import_dataset("bop", bop_root, tmp_path / "bags", detections=path)
    first = {bag.name: given_masks(bag)[0] for bag in bags}
    np.testing.assert_array_equal(first["000048_obj5"] == 255, spot(10))
    np.testing.assert_array_equal(first["000048_obj2"] == 255, spot(30))


def test_detections_are_undistorted_with_their_images(shirt_root, tmp_path):
    """A mask drawn where the lens puts the target comes out where the pinhole puts it."""
    model = save_mesh(tmp_path / "cad.ply")
    plain = next(iter(open_dataset("shirt", shirt_root, model, ["roe1_synthetic"])))
    mask = 255 * spot(5).astype(np.uint8)
    save(tmp_path / "masks" / "img000001.png", mask)
    (bag,) = import_dataset(
        "shirt", shirt_root, tmp_path / "out", model=model, sequences=["roe1_synthetic"], detections=tmp_path / "masks"
    )
    first, second, _ = given_masks(bag)
    assert first is None
    np.testing.assert_array_equal(second, plain._rectify(mask, plain.files[1].image, cv2.INTER_NEAREST))
    assert (second != mask).any()


def test_swisscube_detections_by_image_number(tmp_path):
    root = tmp_path / "swisscube"
    write_scene(root / "testing" / "seq_000400" / "000000")
    save_mesh(root / "models" / "obj_000001.ply", (100, 60, 30))
    path = write_json(tmp_path / "detections" / "seq_000400.json", [cnos(1, spot(15))])
    (bag,) = import_dataset("swisscube", root, tmp_path / "bags", detections=path.parent)
    assert [mask is None for mask in given_masks(bag)] == [True, False, True]


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ([cnos("other.png", spot(5))], r"none of its 1 detections names an image of clip.*like 000000\.jpg"),
        ([cnos(0, spot(5, 60, 80))], "is 80x60 but the image is 160x120"),
        ([cnos(0, spot(5), scene_id=1), cnos(1, spot(5), scene_id=2)], "detections of 2 scenes"),
        ("{", "not valid JSON"),
    ],
)
def test_detections_that_do_not_fit(sequence, tmp_path, data, says):
    path = tmp_path / "cnos.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    with pytest.raises(DatasetError, match=says):
        import_dataset("sequence", sequence, tmp_path / "bag", detections=path)
    assert not (tmp_path / "bag").exists()


def test_a_bag_made_with_other_masks_or_another_model_is_written_again(sequence, tmp_path, caplog):
    def masks(**more):
        (bag,) = import_dataset("sequence", sequence, tmp_path / "bag", **more)
        return [None if mask is None else mask.tobytes() for mask in given_masks(bag)]

    own = masks()
    path = write_json(tmp_path / "cnos.json", [cnos(0, spot(20))])
    found = masks(detections=path)
    assert found != own and "detections" in caplog.text
    caplog.clear()
    assert masks(detections=path) == found and not caplog.text, "the same again is left alone"
    write_json(path, [cnos(0, spot(24))])
    assert masks(detections=path) != found and "detections_sha256" in caplog.text
    assert masks() == own
    assert not (tmp_path / "bag.partial").exists()


def test_a_bag_that_no_import_made_keeps_its_masks(sequence, tmp_path):
    (bag,) = import_dataset("sequence", sequence, tmp_path / "bag")
    (bag / IMPORT_FILE).unlink()
    (bag / "manifest.json").unlink()
    assert import_dataset("sequence", sequence, bag) == [bag]
    with pytest.raises(UsageError, match="no import has made"):
        import_dataset("sequence", sequence, bag, detections=write_json(tmp_path / "cnos.json", [cnos(0, spot(20))]))


def test_detections_and_boxes_from_the_labels_exclude_each_other(sequence, tmp_path):
    with pytest.raises(UsageError, match="choose one"):
        import_dataset("sequence", sequence, tmp_path / "bag", detections=tmp_path / "x.json", boxes=True)
    with pytest.raises(DatasetError, match="no such file or folder of detections"):
        import_dataset("sequence", sequence, tmp_path / "bag", detections=tmp_path / "x.json")


# ---------------------------------------------------------------- what the model names


def test_an_imported_bag_has_the_textures_of_its_model_in_the_manifest(bop_root, tmp_path):
    models = bop_root / "models"
    (models / "maps").mkdir()
    cv2.imwrite(str(models / "maps" / "tex.png"), np.full((4, 4, 3), (20, 40, 200), np.uint8))
    (models / "obj_000002.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile maps/tex.png\nelement vertex 4\nproperty float x\n"
        "property float y\nproperty float z\nproperty float s\nproperty float t\nelement face 4\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0 0.5 0.5\n90 0 0 0.5 0.5\n0 80 0 0.5 0.5\n"
        "0 0 70 0.5 0.5\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
    )
    bag = import_dataset("bop", bop_root, tmp_path / "bags", sequences=["000048_obj2"])[0]
    listed = json.loads((bag / "manifest.json").read_text())["sha256"]
    assert "maps/tex.png" in listed
    (recording,) = open_dataset("bop", bop_root, sequences=["000048_obj2"])
    here, there = load_target(recording.target_path, recording.unit_scale), load_target(bag / "target.yaml")
    assert here.sha256 == there.sha256 and (there.face_rgb == (200, 40, 20)).all()
    np.testing.assert_array_equal(here.surface.textures[0], there.surface.textures[0])
    (bag / "maps" / "tex.png").unlink()
    with pytest.raises(BagError, match=r"lacks maps/tex\.png"):
        BagReader(bag)
    cv2.imwrite(str(models / "maps" / "tex.png"), np.full((4, 4, 3), (200, 40, 20), np.uint8))
    import_dataset("bop", bop_root, tmp_path / "bags", sequences=["000048_obj2"])
    assert (load_target(bag / "target.yaml").face_rgb == (20, 40, 200)).all()


# ---------------------------------------------------------------- several instances of one object


@pytest.fixture
def two_instances(tmp_path):
    """A scene with one object twice, 5 m apart, whose entries stand in another order in the second image."""
    root = tmp_path / "bop"
    scene = root / "test" / "000001"
    write_scene(scene, object_ids=(1, 1))
    save_mesh(root / "models" / "obj_000001.ply", (100, 60, 30))
    gt = json.loads((scene / "scene_gt.json").read_text())
    gt["1"].reverse()
    for slot in (0, 1):
        (scene / "mask_visib" / f"000001_{slot:06d}.png").rename(scene / f"{slot}.png")
    for slot in (0, 1):
        (scene / f"{slot}.png").rename(scene / "mask_visib" / f"000001_{1 - slot:06d}.png")
    for entries, far in zip(gt.values(), (1, 0, 1), strict=True):  # 5 m apart, so that they can be told apart
        entries[far]["cam_t_m2c"][0] += 5000
    (scene / "scene_gt.json").write_text(json.dumps(gt))
    return root


def test_a_bop_scene_with_two_instances_becomes_two_recordings(two_instances):
    root = two_instances
    first, second = open_dataset("bop", root)
    assert [first.name, second.name] == ["000001_obj1_inst0", "000001_obj1_inst1"]
    for index, (near, far) in enumerate(zip(first.truth().values(), second.truth().values(), strict=True)):
        np.testing.assert_allclose(near, POSES[index], atol=1e-6)
        np.testing.assert_allclose(far[:3, 3] - near[:3, 3], [5.5, 0, 0], atol=1e-6)
    assert [np.flatnonzero(first.given_mask(item)[:, 0])[0] for item in first.files] == [10, 10, 10]
    assert [np.flatnonzero(second.given_mask(item)[:, 0])[0] for item in second.files] == [20, 20, 20]
    assert [r.name for r in open_dataset("bop", root, sequences=["000001_obj1_inst1"])] == ["000001_obj1_inst1"]
    assert len(list(open_dataset("bop", root, sequences=["000001_obj1"]))) == 2


def test_one_of_several_instances_is_imported(two_instances, bop_root, tmp_path):
    out = tmp_path / "bags"
    bags = import_dataset("bop", two_instances, out, instance=1)
    assert [bag.name for bag in bags] == ["000001_obj1_inst1"] == [path.name for path in out.iterdir()]
    rows = list(BagReader(bags[0]).truth_rows().values())
    np.testing.assert_allclose([row[0] for row in rows], [T[0, 3] + 5.5 for T in POSES], atol=1e-6)
    with pytest.raises(DatasetError, match="no instance 2: in what is imported instances have the numbers 0 to 1"):
        import_dataset("bop", two_instances, out, instance=2)
    with pytest.raises(DatasetError, match="no instance 0: in what is imported no object occurs twice"):
        import_dataset("bop", bop_root, out, instance=0)


# ---------------------------------------------------------------- SPEED, SPEED+


def write_speed(root, domain, name, labels, truth=True):
    folder = root / domain
    entries = []
    for index in labels:
        save(folder / "images" / f"img{index:06d}.jpg", image(index))
        T = POSES[index]
        pose = {"q_vbs2tango_true": wxyz(T), "r_Vo2To_vbs_true": T[:3, 3].tolist()}
        entries.append({"filename": f"img{index:06d}.jpg", **(pose if truth else {})})
    (folder / f"{name}.json").write_text(json.dumps(entries))


@pytest.fixture
def speed_root(tmp_path):
    root = tmp_path / "speedplus"
    root.mkdir()
    calibration = {"cameraMatrix": K.tolist(), "distCoeffs": [-0.2, 0.5, 0.0, 0.0, 0.0], "Nu": 160, "Nv": 120}
    (root / "camera.json").write_text(json.dumps(calibration))
    write_speed(root, "synthetic", "train", [0, 1])
    write_speed(root, "synthetic", "validation", [2])
    write_speed(root, "lightbox", "test", [0, 2])
    return root


def test_speed_lists_become_recordings(speed_root, tmp_path):
    mesh = save_mesh(tmp_path / "tango.stl")
    found = {r.name: r for r in open_dataset("speed", speed_root, mesh)}
    assert sorted(found) == ["lightbox_test", "synthetic_train", "synthetic_validation"]
    train = found["synthetic_train"]
    np.testing.assert_allclose(list(train.truth().values()), POSES[:2], atol=1e-9)
    assert (train.camera.width, train.camera.height) == (160, 120) and train.distortion[0] == -0.2
    assert [r.name for r in open_dataset("speed", speed_root / "lightbox", mesh)] == ["test"]
    bag = import_dataset("speed", speed_root, tmp_path / "out", model=mesh, sequences=["lightbox_test"])[0]
    assert len(BagReader(bag).truth_rows()) == 2


def test_speed_without_labels_or_with_a_part_of_the_images(speed_root, tmp_path, caplog):
    mesh = save_mesh(tmp_path / "tango.stl")
    write_speed(speed_root, "sunlamp", "test", [0, 1], truth=False)
    (speed_root / "sunlamp" / "images" / "img000000.jpg").unlink()
    (recording,) = open_dataset("speed", speed_root, mesh, ["sunlamp_test"])
    assert recording.truth() == {} and [item.stamp_ns for item in recording.files] == [stamp_of(1)]
    assert "1 of its 2 images are not there" in caplog.text


@pytest.mark.parametrize("name", ["/etc/img000000.jpg", "../img000000.jpg", "images/../img000000.jpg"])
def test_speed_images_outside_their_folder_are_refused_unread(speed_root, tmp_path, monkeypatch, name):
    labels = speed_root / "synthetic" / "train.json"
    entries = json.loads(labels.read_text())
    labels.write_text(json.dumps([{**entry, "filename": name} for entry in entries]))
    looked_at, is_file = [], Path.is_file
    monkeypatch.setattr(Path, "is_file", lambda self: looked_at.append(self.name) or is_file(self))
    with pytest.raises(DatasetError, match=r"train\.json, entry 0: .* leads out of .*images"):
        list(open_dataset("speed", speed_root, save_mesh(tmp_path / "tango.stl")))
    assert "img000000.jpg" not in looked_at


@pytest.mark.parametrize(
    ("camera", "says"),
    [({"Nu": 160}, "expected cameraMatrix"), ({"cameraMatrix": [1], "Nu": 160, "Nv": 120}, "camera matrix 3x3")],
)
def test_bad_speed_camera(speed_root, tmp_path, camera, says):
    (speed_root / "camera.json").write_text(json.dumps(camera))
    with pytest.raises(DatasetError, match=says):
        list(open_dataset("speed", speed_root, save_mesh(tmp_path / "tango.stl")))


def test_old_speed_names_its_labels_and_its_camera_otherwise(tmp_path):
    root, mesh = tmp_path / "speed", save_mesh(tmp_path / "tango.stl")
    save(root / "images" / "train" / "img0.jpg", image(0))
    camera = {"fx": 0.003, "fy": 0.0031, "ppx": 1e-5, "ppy": 1e-5, "Nu": 160, "Nv": 120}
    (root / "camera.json").write_text(json.dumps(camera))
    T = POSES[0]
    labels = [{"filename": "img0.jpg", "q_vbs2tango": wxyz(T), "r_Vo2To_vbs_m": T[:3, 3].tolist()}]
    (root / "train.json").write_text(json.dumps(labels))
    (recording,) = open_dataset("speed", root, mesh)
    np.testing.assert_allclose(recording.camera.K, [[300, 0, 79.5], [0, 310, 59.5], [0, 0, 1]])
    np.testing.assert_allclose(recording.truth()[stamp_of(0)], T, atol=1e-9)


def test_speed_needs_a_model_and_lists(speed_root, tmp_path):
    with pytest.raises(DatasetError, match="--model"):
        list(open_dataset("speed", speed_root))
    with pytest.raises(DatasetError, match=r"train\.json"):
        list(open_dataset("speed", tmp_path, save_mesh(tmp_path / "tango.stl")))


# ---------------------------------------------------------------- YCB-Video as published


def write_ycb_video(folder, frames=(0, 1, 2), classes=(2, 5), suffix="png"):
    for frame in frames:
        stem = f"{frame + 1:06d}"
        save(folder / f"{stem}-color.{suffix}", image(frame))
        label = np.zeros((120, 160), np.uint8)
        poses = np.zeros((3, 4, len(classes)))
        for slot, number in enumerate(classes):
            label[10 + 20 * slot : 25 + 20 * slot, 30:50] = number
            poses[:, :, slot] = POSES[frame][:3]
            poses[0, 3, slot] += slot
        save(folder / f"{stem}-label.png", label)
        meta = {"cls_indexes": np.array(classes)[:, None], "poses": poses, "intrinsic_matrix": K, "factor_depth": 10000}
        scipy.io.savemat(folder / f"{stem}-meta.mat", meta)


@pytest.fixture
def ycb_root(tmp_path):
    root = tmp_path / "YCB_Video_Dataset"
    write_ycb_video(root / "data" / "0048")
    for number in range(1, 6):
        save_mesh(root / "models" / f"{number + 1:03d}_thing" / "textured.obj", (0.1 * number, 0.06, 0.03))
    return root


def test_ycb_video_objects_become_recordings(ycb_root, tmp_path):
    two, five = open_dataset("ycb_video", ycb_root)
    assert [two.name, five.name] == ["0048_obj2", "0048_obj5"]
    np.testing.assert_allclose(list(two.truth().values()), POSES, atol=1e-9)
    assert list(two.truth()) == [stamp_of(number) for number in (1, 2, 3)]
    np.testing.assert_allclose(five.truth()[stamp_of(2)][:3, 3] - POSES[1][:3, 3], [1, 0, 0], atol=1e-9)
    for recording, top in ((two, 10), (five, 30)):
        assert np.flatnonzero(recording.given_mask(recording.files[0])[:, 40]).tolist() == list(range(top, top + 15))
        assert np.ptp(load_target(recording.target_path).vertices_m[:, 0]) == pytest.approx(0.2 if top == 10 else 0.5)
    bag = import_dataset("ycb_video", ycb_root, tmp_path / "bags", sequences=["0048_obj5"])[0]
    assert len(BagReader(bag).truth_rows()) == 3


def test_ycb_video_bare_folder_of_frames(tmp_path):
    write_ycb_video(tmp_path / "frames", classes=(7,), suffix="jpg")
    (recording,) = open_dataset("ycb_video", tmp_path / "frames", save_mesh(tmp_path / "drill.ply"))
    assert recording.name == "obj7" and len(recording.truth()) == 3
    with pytest.raises(DatasetError, match=r"no folder 'models'.*object 7"):
        list(open_dataset("ycb_video", tmp_path / "frames"))


def test_bad_ycb_video(ycb_root, tmp_path):
    frames = ycb_root / "data" / "0048"
    with pytest.raises(DatasetError, match=r"--model is one CAD model.*2, 5"):
        list(open_dataset("ycb_video", ycb_root, save_mesh(tmp_path / "m.ply")))
    with pytest.raises(DatasetError, match=r"no frame like 000001-meta\.mat"):
        list(open_dataset("ycb_video", tmp_path))
    scipy.io.savemat(frames / "000002-meta.mat", {"cls_indexes": [[1]], "poses": np.eye(3)})
    with pytest.raises(DatasetError, match=r"000002-meta\.mat: expected cls_indexes"):
        list(open_dataset("ycb_video", ycb_root))
    (frames / "000002-meta.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    with pytest.raises(DatasetError, match="not a MATLAB file"):
        list(open_dataset("ycb_video", ycb_root))


@pytest.mark.parametrize("bits", [10, 12, 16])
@pytest.mark.parametrize("extension", ["png", "tiff"])
def test_files_of_16_bits_are_read_by_their_depth_in_place_as_from_the_bag(sequence, tmp_path, bits, extension):
    names = [f"wide{index}.{extension}" for index in range(3)]
    for index, name in enumerate(names):
        picture = image(index)
        picture[0, 0] = 255
        # The first frame is dark: by itself it could be one of fewer bits.
        save(sequence / "images" / name, (picture // (1 if index else 8)).astype(np.uint16) << (bits - 8))
    write_labels(sequence, CAMERA, "target.ply", "test", POSES, names)
    recording = load_sequence(sequence)
    frames = list(recording.frames())
    for index in (1, 2):
        assert np.array_equal(frames[index].rgb[1:], image(index)[1:])
    (bag,) = import_dataset("sequence", sequence, tmp_path / "bag")
    for here, there in zip(frames, BagReader(bag).frames(), strict=True):
        assert np.array_equal(here.rgb, there.rgb)
    assert [frame.stamp_ns for frame in recording.frames(start=1)] == [stamp_of(1), stamp_of(2)]
    told = replace(recording, image_depth="16")
    assert np.array_equal(next(told.frames(start=1)).rgb[1:], image(1)[1:] >> (16 - bits))


def test_files_of_real_numbers_are_refused(sequence):
    save(sequence / "images" / "real.tiff", image(0).astype(np.float32))
    write_labels(sequence, CAMERA, "target.ply", "test", POSES[:1], ["real.tiff"])
    with pytest.raises(DatasetError, match=r"real\.tiff: an image must have 8 or 16 bits per value, found float32"):
        next(load_sequence(sequence).frames())


def test_a_target_yaml_as_the_model_of_a_data_set(speed_root, tmp_path):
    save_mesh(tmp_path / "tango.stl", (800.0, 700.0, 400.0))
    yaml = tmp_path / "target.yaml"
    for scale in (0.001, 0.002):
        yaml.write_text(f"mesh: tango.stl\nunit_scale: {scale}\n")
        bag = import_dataset("speed", speed_root, tmp_path / "out", model=yaml, sequences=["lightbox_test"])[0]
        target = load_target(bag / "target.yaml")
        assert np.ptp(target.vertices_m[:, 0]) == pytest.approx(800 * scale)
    (recording,) = open_dataset("speed", speed_root, yaml, ["lightbox_test"])
    assert load_target(recording.target_path, recording.unit_scale).sha256 == target.sha256
