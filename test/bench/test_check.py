"""What `hat check` tells of a recording and a CAD model, and when it says that a run cannot read them."""

import json

import cv2
import numpy as np
import pytest
import trimesh
from scripted import CAMERA, frame, mask, stamp, true_row

from hat_ros.bench.check import Frames, frame_lines, notes, read_frames, recording_lines
from hat_ros.bench.source import open_source
from hat_ros.bench.synth.models import write_model
from hat_ros.cli import main
from hat_ros.errors import FrameError
from hat_ros.geometry import lie
from hat_ros.io.bag_writer import BagWriter
from hat_ros.target.loading import load_target


class AsWritten(BagWriter):
    """The bag's time is the order of writing, whatever the stamps are."""

    def write_cdr(self, topic, kind, data, log_ns):
        self.count = getattr(self, "count", 0) + 1
        super().write_cdr(topic, kind, data, self.count)


def write_bag(folder, indices, masks=True, truth=True, pose=lambda i: lie.matrix_from_row(true_row(i))):
    model = folder.parent / "cubesat.glb"
    write_model("cubesat", model)
    with AsWritten(folder, image_format="png") as writer:
        for i in indices:
            given = mask().astype(np.uint8) * np.uint8(255) if masks else None
            T = pose(i) if truth else None
            writer.write_frame(stamp(i), frame(i).rgb, CAMERA, mask=given, T_cam_target=T)
        writer.write_target(model)
    return folder


def behind(index):
    return lie.transform(np.eye(3), np.array([0.0, 0.0, -5.0 - index]))


def write_clip(folder, count=4, size=(64, 48)):
    (folder / "images").mkdir(parents=True)
    write_model("cubesat", folder / "target.glb")
    for i in range(count):
        image = np.zeros((48, 64, 3), np.uint8)
        image[:, :16] = 255
        cv2.imwrite(str(folder / "images" / f"{i}.png"), image)
    names = [{"file": f"{i}.png"} for i in range(count)]
    labels = {"K": CAMERA.K.tolist(), "size": list(size), "mesh": "target.glb", "frames": names}
    (folder / "labels.json").write_text(json.dumps(labels))
    return folder


def told(source):
    found = read_frames(source)
    return dict([*recording_lines(source), *frame_lines(found, source)])


def test_bag_is_told_whole(tmp_path):
    lines = told(open_source(write_bag(tmp_path / "bag", range(10))))
    assert lines["frames"] == "10 looked at of 10, 0 refused"
    assert lines["rate"].startswith("10.000 Hz")
    assert lines["duration"].startswith("0.900 s")
    assert lines["gaps"] == "none"
    assert lines["ground truth"] == "10 poses"
    assert lines["checksums"] == "manifest.json agrees"
    assert lines["camera matrix"] == "fx 100.00, fy 100.00, cx 31.50, cy 23.50 px"
    assert "35.5 x 27.0 deg" in lines["image size"]
    assert lines["target in the image"].startswith("24 to 24 px") and "given masks" in lines["target in the image"]


def test_backward_and_duplicate_stamps_are_refused_as_in_a_run(tmp_path):
    lines = told(open_source(write_bag(tmp_path / "bag", [0, 1, 2, 2, 1, 3, 9])))
    assert lines["frames"] == "7 looked at of 7, 2 refused"
    assert lines["backward stamps"] == "1, duplicates 1"
    assert "header.stamp must increase" in lines["refused"] and lines["refused"].startswith("2 x")
    assert lines["gaps"] == "1, the longest 0.600 s"


def test_size_comes_from_the_truth_where_there_are_no_masks(tmp_path):
    known = told(open_source(write_bag(tmp_path / "a", range(3), masks=False)))
    unknown = told(open_source(write_bag(tmp_path / "b", range(3), masks=False, truth=False)))
    assert "ground truth" in known["target in the image"]
    assert unknown["target in the image"].startswith("unknown")


def test_masks_that_the_cad_model_does_not_fill_are_warned_of(tmp_path):
    bag = write_bag(tmp_path / "bag", range(3))
    assert "warning" not in told(open_source(bag))
    (bag / "manifest.json").unlink()
    named = (bag / "target.yaml").read_text().splitlines()
    changed = ["unit_scale: 0.1" if line.startswith("unit_scale") else line for line in named]
    (bag / "target.yaml").write_text("\n".join(changed))
    assert "times as large as the CAD model" in told(open_source(bag))["warning"]


def test_clip_and_its_grey_levels(tmp_path):
    lines = told(open_source(write_clip(tmp_path / "clip")))
    assert lines["encoding"] == ".png (4)"
    assert lines["black pixels"] == "75.0%, at most 75.0%"
    assert lines["saturated pixels"] == "25.0%, at most 25.0%"
    assert lines["given masks"] == "0 of 4 frames"


def test_limit_leaves_the_rest_unread(tmp_path):
    found = read_frames(open_source(write_clip(tmp_path / "clip")), 2)
    assert len(found.stamps_ns) == 2 and sum(found.encodings.values()) == 2


def test_recording_without_frames_cannot_run(tmp_path):
    with pytest.raises(FrameError, match="the recording has none"):
        list(frame_lines(Frames(), open_source(write_clip(tmp_path / "clip"))))


def test_poses_behind_the_camera_have_no_size(tmp_path):
    bag = open_source(write_bag(tmp_path / "bag", range(2), masks=False, pose=behind))
    assert told(bag)["target in the image"].startswith("unknown")


def test_what_is_logged_becomes_lines(tmp_path):
    trimesh.creation.box((264.0, 100.0, 50.0)).export(tmp_path / "box_in_mm.stl")
    with notes() as lines:
        load_target(tmp_path / "box_in_mm.stl")
    assert any(label == "warning" and "check unit_scale" in text for label, text in lines)


def test_cad_in_millimetres_is_warned_of_and_nothing_is_written(tmp_path, capsys):
    path = tmp_path / "panel_in_mm.stl"
    trimesh.creation.box((300.0, 200.0, 100.0)).export(path)
    assert main(["check", str(path)]) == 0
    out = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "warning" in out and "check unit_scale" in out
    assert "300 x 200 x 100 m" in out and "taken as grey" in out
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_picture_is_written_only_where_asked(tmp_path):
    clip = write_clip(tmp_path / "clip")
    before = sorted(clip.rglob("*"))
    assert main(["check", str(clip), "--out", str(tmp_path / "look.png")]) == 0
    assert cv2.imread(str(tmp_path / "look.png")).shape == (960, 960, 3)
    assert sorted(clip.rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["{tmp}/none"], "no such file"),
        (["{tmp}"], "neither a bag"),
        (["{tmp}/wrong"], "the calibration says"),
        (["{tmp}/note.txt"], "format"),
        (["{tmp}/wrong", "--out", "{tmp}/none/a.png"], "in a folder that exists"),
        (["{tmp}/wrong", "--out", "{tmp}/a.jpg"], "ends in .png"),
        (["{tmp}/late"], "no frame can be used"),
    ],
)
def test_what_cannot_run_is_one_sentence_and_exit_code_2(tmp_path, capsys, words, sentence):
    write_clip(tmp_path / "wrong", size=(32, 32))
    (tmp_path / "note.txt").write_text("x")
    write_bag(tmp_path / "late", [-10])
    assert main(["check", *(word.format(tmp=tmp_path) for word in words)]) == 2
    assert sentence in capsys.readouterr().err.strip().splitlines()[-1]


@pytest.mark.parametrize("name", ["folder.png", f"{'x' * 300}.png"])
def test_picture_that_cannot_be_written_is_one_sentence(tmp_path, capsys, name):
    (tmp_path / "folder.png").mkdir()
    assert main(["check", str(write_clip(tmp_path / "clip")), "--out", str(tmp_path / name)]) == 1
    said = capsys.readouterr()
    assert "choose a place that can be written" in said.err
    assert "target in the image" in said.out
