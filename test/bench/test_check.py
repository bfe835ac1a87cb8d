"""What `hat check` tells of a recording and a CAD model, and when it says that a run cannot read them."""

import json
import re

import cv2
import numpy as np
import pytest
import trimesh
from checked_recording import behind, write_bag, write_clip
from scripted import stamp

from hat_ros.bench.check import frame_lines, notes, recording_lines
from hat_ros.bench.check_frames import Frames, read_frames
from hat_ros.bench.source import open_source
from hat_ros.bench.synth.clips import ClipSpec, render_clip
from hat_ros.bench.synth.models import write_model
from hat_ros.cli import main
from hat_ros.errors import FrameError
from hat_ros.io.bag_writer import BagWriter
from hat_ros.target.loading import load_target


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


def test_a_long_recording_is_sampled_and_says_so(tmp_path, capsys):
    clip = write_clip(tmp_path / "clip", 30)
    assert main(["check", str(clip), "--decode", "7"]) == 0
    assert "30 looked at of 30, 0 refused; of 7 of them" in " ".join(capsys.readouterr().out.split())


def test_a_sequence_of_a_data_set_is_checked_with_its_detections(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "400")
    clip = write_clip(tmp_path / "clip")
    (tmp_path / "found.json").write_text(json.dumps({f"{i}.png": [9.5, 9.5, 29.5, 20.5] for i in range(4)}))
    given = ["check", str(clip), "--dataset", "sequence", "--sequence", "clip"]
    assert main([*given, "--detections", str(tmp_path / "found.json"), "--model", str(clip / "target.glb")]) == 0
    out = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "20 to 20 px" in out and "by given masks" in out
    assert main(["check", str(clip), "--dataset", "sequence"]) == 2
    assert "--dataset and --sequence belong together" in capsys.readouterr().err


def test_the_unit_of_a_bare_cad_file_can_be_given(tmp_path, capsys):
    path = tmp_path / "panel.stl"
    trimesh.creation.box((300.0, 200.0, 100.0)).export(path)
    assert main(["check", str(path), "--unit-scale", "0.001"]) == 0
    assert "0.3 x 0.2 x 0.1 m" in capsys.readouterr().out
    assert main(["check", str(write_clip(tmp_path / "clip")), "--unit-scale", "0.001"]) == 2
    assert "--unit-scale is for a CAD file alone" in capsys.readouterr().err


def rendered_bag(folder, truth=True, unit_scale=1.0):
    """A target that Stage 1 finds."""
    model = folder.parent / "cubesat.glb"
    write_model("cubesat", model)
    spec = ClipSpec(frames=3, width=160, height=120, focal_px=260.0, range_m=(2.6, 2.3), supersample=1)
    with BagWriter(folder) as writer:
        for i, one in enumerate(render_clip(load_target(model), spec)):
            T = one.T_cam_target if truth else None
            writer.write_frame(stamp(i), one.rgb, spec.camera, T_cam_target=T)
        writer.write_target(model, unit_scale)
    return folder


def test_without_masks_and_truth_the_target_is_sought(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "400")

    def lines(bag):
        assert main(["check", str(bag)]) == 0
        return " ".join(capsys.readouterr().out.replace("│", " ").split())

    known = lines(rendered_bag(tmp_path / "known"))
    unknown = lines(rendered_bag(tmp_path / "unknown", truth=False))
    pattern = r"target in the image (\d+) to (\d+) px, over time [\d, ]+ px \(by ([\w ]+)\)"
    truth, found = (re.search(pattern, text).groups() for text in (known, unknown))
    assert (truth[2], found[2]) == ("ground truth", "Stage 1 on single frames")
    np.testing.assert_allclose([float(x) for x in found[:2]], [float(x) for x in truth[:2]], rtol=0.2)
    assert "times as large" not in known
    assert "masks that Stage 1 finds are" in lines(rendered_bag(tmp_path / "small", unit_scale=0.1))


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
