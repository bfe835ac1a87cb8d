"""Where recordings come from: data sets as published are read without writing a bag."""

import csv
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from hat_ros.bench.datasets.pose_files import read_poses
from hat_ros.bench.datasets.sequence import read_json
from hat_ros.bench.experiments.comparison import bench_jobs, clips_of_dataset
from hat_ros.bench.source import SourceSpec, open_source
from hat_ros.bench.synth.models import write_model
from hat_ros.cli import main
from hat_ros.errors import DatasetError, InputError, UsageError


@pytest.fixture
def spark(tmp_path):
    """Two sequences of two frames in the SPARK layout."""
    root = tmp_path / "spark"
    rows = []
    for sequence in ("RT500", "RT501"):
        (root / "images" / sequence).mkdir(parents=True)
        for i in range(2):
            name = f"img{i:03d}.jpg"
            cv2.imwrite(str(root / "images" / sequence / name), np.zeros((1080, 1440, 3), np.uint8))
            rows.append([sequence, name, 0.1, 0.2, 6.0 + i, 0, 0, 0, 1])
    with (root / "labels.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["sequence", "filename", "Tx", "Ty", "Tz", "Qx", "Qy", "Qz", "Qw"])
        writer.writerows(rows)
    write_model("cubesat", tmp_path / "cubesat.glb")
    return root, tmp_path / "cubesat.glb"


def test_sequences_become_clips_of_one_group(spark):
    root, model = spark
    clips = clips_of_dataset("spark", root, model, ())
    assert [(spec.name, spec.group) for spec, _ in clips] == [("RT500", "spark"), ("RT501", "spark")]
    (job, _) = bench_jobs(clips, ["hat"], ["own"], [0], "default")
    command = " ".join(job.command(root / "out"))
    assert "--dataset spark --sequence RT500 --model" in command


def test_sequence_opens_with_target_and_truth(spark):
    root, model = spark
    source = SourceSpec(root, "spark", "RT501", model).open()
    assert len(list(source.frames())) == 2
    assert source.target.name == "cubesat"
    np.testing.assert_allclose(sorted(row[2] for row in source.truth_rows().values()), [6.0, 7.0])


def test_hash_covers_images_labels_and_model_of_this_sequence_only(spark):
    root, model = spark
    spec, other = (SourceSpec(root, "spark", name, model) for name in ("RT500", "RT501"))
    before = spec.sha256(), other.sha256()
    assert (spec.sha256(), other.sha256()) == before
    cv2.imwrite(str(root / "images" / "RT500" / "img001.jpg"), np.full((1080, 1440, 3), 9, np.uint8))
    assert spec.sha256() != before[0]
    assert other.sha256() == before[1]
    write_model("probe", model)
    assert other.sha256() != before[1]


def test_unknown_sequence_or_layout_is_refused(spark):
    root, model = spark
    with pytest.raises(DatasetError, match="RT999"):
        SourceSpec(root, "spark", "RT999", model).open()
    with pytest.raises(UsageError, match="format 'kitti'"):
        SourceSpec(root, "kitti", "00", model).open()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["track", "{root}", "--out", "{root}/o", "--dataset", "spark"], "belong together"),
        (["bench", "--out", "{root}/o", "--dataset", "spark"], "belong together"),
        (["bench", "--out", "{root}/o"], "nothing to run"),
        (["bench", "--out", "{root}/o", "--dataset", "spark", "--root", "{root}"], "--model"),
    ],
)
def test_incomplete_data_set_options_are_exit_code_2(spark, capsys, arguments, sentence):
    root, _ = spark
    assert main([text.format(root=root) for text in arguments]) == 2
    assert sentence in capsys.readouterr().err


def test_detections_computed_elsewhere_are_used_in_place(spark, tmp_path):
    root, model = spark
    folder = tmp_path / "detections"
    folder.mkdir()
    for name, left in (("RT500", 100), ("RT501", 200)):
        (folder / f"{name}.json").write_text(json.dumps({"img001.jpg": [left, 50, left + 40, 80]}))
    clips = clips_of_dataset("spark", root, model, (), folder)
    for (spec, _), left in zip(clips, (100, 200), strict=True):
        first, second = (frame.given_mask for frame in spec.open().frames())
        assert first is None
        assert np.flatnonzero((second == 128).any(axis=0))[[0, -1]].tolist() == [left, left + 39]
    (job, _) = bench_jobs(clips, ["hat"], ["given"], [0], "default")
    assert f"--detections {folder}/RT500.json" in " ".join(job.command(tmp_path))
    spec = clips[0][0]
    before, told = spec.sha256(), spec.describe()
    assert told["detections"] == str((folder / "RT500.json").resolve())
    (folder / "RT500.json").write_text(json.dumps({"img001.jpg": [0, 0, 40, 80]}))
    assert spec.sha256() != before != SourceSpec(root, "spark", "RT500", model).sha256()
    assert spec.describe()["detections_sha256"] != told["detections_sha256"]


def test_a_bag_has_its_detections_in_it(tmp_path):
    (tmp_path / "metadata.yaml").write_text("")
    with pytest.raises(UsageError, match="hat import"):
        SourceSpec(tmp_path, detections=tmp_path / "boxes.json").open()


def test_shirt_regions_come_from_its_labels(tmp_path):
    root = tmp_path / "shirt"
    (root / "roe1" / "synthetic" / "images").mkdir(parents=True)
    cv2.imwrite(str(root / "roe1" / "synthetic" / "images" / "img1.jpg"), np.zeros((120, 160, 3), np.uint8))
    calibration = {"cameraMatrix": [[300, 0, 80], [0, 300, 60], [0, 0, 1]], "distCoeffs": [], "Nu": 160, "Nv": 120}
    (root / "camera.json").write_text(json.dumps(calibration))
    label = {"filename": "img1.jpg", "q_vbs2tango_true": [1, 0, 0, 0], "r_Vo2To_vbs_true": [0, 0, 4]}
    (root / "roe1" / "roe1.json").write_text(json.dumps([label]))
    write_model("cubesat", tmp_path / "cubesat.glb")
    source = SourceSpec(root, "shirt", "roe1_synthetic", tmp_path / "cubesat.glb").open()
    (frame,) = source.frames()
    assert set(np.unique(frame.given_mask)) == {0, 128}
    assert next(source.frames(masks=False)).given_mask is None
    ((stamp_ns, mask),) = source.masks()
    assert stamp_ns == frame.stamp_ns and np.array_equal(mask, frame.given_mask)


@pytest.mark.parametrize("name", ["/etc/hostname", "../secret.png", "a/../../secret.png", "a\0b.png"])
@pytest.mark.parametrize("key", ["image", "mesh"])
def test_labels_must_not_lead_out_of_their_folder(tmp_path, name, key):
    clip = tmp_path / "clip"
    (clip / "images").mkdir(parents=True)
    (tmp_path / "secret.png").write_bytes(b"x")
    write_model("cubesat", clip / "target.glb")
    labels = {
        "K": [[100, 0, 50], [0, 100, 50], [0, 0, 1]],
        "size": [100, 100],
        "mesh": name if key == "mesh" else "target.glb",
        "frames": [{"file": name}],
    }
    (clip / "labels.json").write_text(json.dumps(labels))
    with pytest.raises(DatasetError, match="leads out of"):
        open_source(clip)


def test_pipes_and_devices_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(UsageError, match="neither a file nor a folder"):
            open_source(path)
        with pytest.raises(InputError, match="is not a file"):
            read_poses(path)
        with pytest.raises(DatasetError, match="is not a file"):
            read_json(path)
