"""The command line: exit codes, one sentence, no traceback, true help, light start."""

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from scripted import CAMERA, ScriptedMethod, frame, mask, stamp, true_row
from temporal_scene import make_scene

from hat_ros.bench.datasets.importer import FORMATS
from hat_ros.bench.methods.temporal import run_offline, run_temporal
from hat_ros.bench.synth.models import write_model
from hat_ros.cli import build_parser, data, main
from hat_ros.config import load_config
from hat_ros.errors import RunError
from hat_ros.geometry import lie
from hat_ros.io.bag_writer import BagWriter

COMMANDS = (
    *("replay", "track", "temporal", "import", "synth", "evaluate", "plot", "score", "bench", "ablate", "config"),
    *("weights", "doctor", "profile", "check", "campaign", "train", "prepare"),
)


@pytest.fixture
def bag(tmp_path):
    model = tmp_path / "cubesat.glb"
    write_model("cubesat", model)
    with BagWriter(tmp_path / "clip", image_format="png") as writer:
        for i in range(10):
            T = lie.matrix_from_row(true_row(i))
            recorded = mask().astype(np.uint8) * np.uint8(255)
            writer.write_frame(stamp(i), frame(i).rgb, CAMERA, mask=recorded, T_cam_target=T)
        writer.write_target(model)
    return tmp_path / "clip"


@pytest.fixture
def scripted(monkeypatch):
    """`hat track` with a method that needs no backend."""
    monkeypatch.setattr("hat_ros.bench.runs.track.create_method", lambda *_: ScriptedMethod())


@pytest.fixture
def settings(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text("keyframes: {gap_frames: 6}\n")
    return str(path)


def test_start_is_light():
    code = (
        "import sys; from hat_ros.cli import build_parser; build_parser().format_help();"
        "print([m for m in ('numpy', 'cv2', 'torch', 'rclpy', 'matplotlib', 'rosbags') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    assert f"usage: hat {command}" in capsys.readouterr().out


def test_commands_are_all_listed():
    text = build_parser().format_help()
    listed = re.findall(r"^    (\w+) ", text, re.MULTILINE)
    assert sorted(set(listed)) == sorted(COMMANDS)


def test_choices_repeated_for_a_light_start_are_the_real_ones():
    assert tuple(FORMATS) == data.FORMATS


BAD_INPUT = [
    (["track", "{tmp}/none", "--out", "{tmp}/out"], "no such file"),
    (["track", "{tmp}", "--out", "{tmp}/out"], "neither a bag"),
    (["track", "{bag}", "--out", "{tmp}/out", "--config", "nope"], "no configuration 'nope'"),
    (["track", "{bag}", "--out", "{tmp}/out", "--config", "{settings}", "--set", "keyframes.gap=1"], "gap_frames"),
    (["track", "{bag}", "--out", "{tmp}/out", "--config", "{settings}", "--set", "keyframes"], "section.key=value"),
    (["track", "{bag}", "--out", "{bag}", "--overwrite"], "not a folder that hat has made"),
    (["track", "{bag}", "--out", "{tmp}/out", "--config", "{settings}", "--start", "10"], "leaves none"),
    (["replay", "{tmp}/none", "--out", "{tmp}/out", "--config", "{settings}"], "no such file"),
    (["temporal", "{tmp}/none.npz", "--out", "{tmp}/o.npz", "--config", "{settings}"], "no such file"),
    (["evaluate", "{tmp}"], "no finished result folder"),
    (["plot", "{tmp}"], "no finished result folder"),
    (["bench", "{tmp}/none", "--out", "{tmp}/out"], "no such file"),
    (["import", "spark", "{tmp}/none", "--out", "{tmp}/out"], "no such folder"),
    (["synth", "teapot", "--out", "{tmp}/out"], "neither a CAD file"),
    (["synth", "cubesat"], "--out is missing"),
    (["synth", "cubesat", "--out", "{tmp}/out", "--range", "-1", "2"], "range_m must be positive"),
    (["weights", "check", "teapot"], "no checkpoint is called"),
    (["weights", "convert"], "name the checkpoint"),
]


@pytest.mark.parametrize(("arguments", "sentence"), BAD_INPUT, ids=[" ".join(a[0][:2]) for a in BAD_INPUT])
def test_bad_input_is_exit_code_2_and_one_sentence(arguments, sentence, bag, settings, tmp_path, capsys):
    filled = [text.format(tmp=tmp_path, bag=bag, settings=settings) for text in arguments]
    assert main(filled) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert said[-1].startswith("hat: ")
    assert sentence in said[-1]
    assert not any("Traceback" in line for line in said)
    assert not (tmp_path / "out").exists()


WRONG_USAGE = (
    "",
    "fly",
    "track",
    "track x --out y --mode magic",
    "track x --out y --limit 0",
    "track x --out y --start -1",
    "bench x --out y --modes hat,magic",
)


@pytest.mark.parametrize("text", WRONG_USAGE)
def test_wrong_usage_is_exit_code_2(text, capsys):
    with pytest.raises(SystemExit) as stop:
        main(text.split())
    assert stop.value.code == 2
    assert "usage: hat" in capsys.readouterr().err


def test_failed_run_is_exit_code_1(monkeypatch, capsys, bag, settings, tmp_path):
    def fail(*_, **__):
        raise RunError("the disk is\nfull")

    monkeypatch.setattr("hat_ros.bench.runs.track.track", fail)
    assert main(["track", str(bag), "--out", str(tmp_path / "out"), "--config", settings]) == 1
    assert capsys.readouterr().err.strip().splitlines()[-1] == "hat: the disk is full"


def test_track_writes_the_promised_folder(scripted, bag, settings, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["track", str(bag), "--out", str(out), "--config", settings]) == 0
    names = {path.name for path in out.iterdir()}
    assert {"bag", "poses.tum", "poses.csv", "config.yaml", "metrics.json", "report.html", "run.json"} <= names
    assert names & {"overlay.mp4", "overlay.avi"}
    metrics = json.loads((out / "metrics.json").read_text())
    promised = ["frames", "valid", "coverage", "E_p_mean", "E_p_sd", "E_t_m_mean", "E_t_m_sd", "E_q_deg_mean"]
    promised += ["E_q_deg_sd", "E_q_over_90_share", "fps", "latency_ms_p50", "latency_ms_p99"]
    assert all(metrics[name] is not None for name in promised)
    assert (metrics["frames"], metrics["valid"]) == (10, 7)
    assert "pose error" in capsys.readouterr().out


@pytest.mark.parametrize(("backend", "given"), [("classical", False), ("annotated", True)])
def test_recorded_masks_reach_the_method_only_when_given_and_judge_its_own_either_way(
    monkeypatch, bag, settings, tmp_path, backend, given
):
    seen = []

    class Sees(ScriptedMethod):
        def step(self, frame):
            seen.append(frame.given_mask is not None)
            return super().step(frame)

    monkeypatch.setattr("hat_ros.bench.runs.track.create_method", lambda *_: Sees())
    command = ["track", str(bag), "--out", str(tmp_path / "out"), "--config", settings, "--quiet", "--no-video"]
    assert main([*command, "--no-report", "--set", f"segmentation.backend={backend}"]) == 0
    assert seen == [given] * 10
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["mask_iou_mean"] == 1.0
    assert len((tmp_path / "out" / "masks.csv").read_text().splitlines()) == 11


def test_evaluate_reproduces_the_metrics_and_keeps_what_was_measured(scripted, bag, settings, tmp_path):
    out = tmp_path / "out"
    main(["track", str(bag), "--out", str(out), "--config", settings, "--quiet", "--no-video", "--no-report"])
    before = (out / "metrics.json").read_text()
    (out / "poses.csv").unlink()
    assert main(["evaluate", str(out)]) == 0
    assert (out / "metrics.json").read_text() == before
    assert (out / "poses.csv").is_file()


def test_evaluate_against_another_truth(scripted, bag, settings, tmp_path):
    out, other = tmp_path / "out", tmp_path / "other"
    main(["track", str(bag), "--out", str(out), "--config", settings, "--quiet", "--no-video", "--no-report"])
    with BagWriter(other, image_format="png") as writer:
        for i in range(20):
            T = lie.matrix_from_row(true_row(i)) @ lie.transform(lie.so3_exp(np.array([0, np.pi, 0])), np.zeros(3))
            writer.write_frame(stamp(i), frame(i).rgb, CAMERA, T_cam_target=T)
        writer.write_target(tmp_path / "cubesat.glb")
    assert main(["evaluate", str(out), "--truth", str(other)]) == 0
    assert json.loads((out / "metrics.json").read_text())["E_q_over_90_share"] == 1.0
    assert json.loads((out / "metrics.json").read_text())["targets"] == 10


def test_track_the_same_twice_gives_the_same_bytes(scripted, bag, settings, tmp_path):
    for name in ("a", "b"):
        options = ["--config", settings, "--quiet", "--no-video", "--no-report"]
        main(["track", str(bag), "--out", str(tmp_path / name), *options])
    for file in ("poses.tum", "poses.csv", "config.yaml"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_sigterm_keeps_what_was_done_as_ctrl_c_does(monkeypatch, bag, settings, tmp_path, capsys):
    class Ends(ScriptedMethod):
        def step(self, seen):
            if seen.stamp_ns == stamp(6):
                os.kill(os.getpid(), signal.SIGTERM)
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(0.5)
            return super().step(seen)

    monkeypatch.setattr("hat_ros.bench.runs.track.create_method", lambda *_: Ends())
    before = signal.getsignal(signal.SIGTERM)
    code = main(["track", str(bag), "--out", str(tmp_path / "out"), "--config", settings, "--quiet"])
    assert code == 143 and "stopped by SIGTERM" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) == before
    assert json.loads((tmp_path / "out.partial" / "metrics.json").read_text())["frames"] >= 1
    assert main(["track", str(bag), "--out", str(tmp_path / "out"), "--config", settings, "--quiet"]) == 143, "replaced"


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_stopped_run_leaves_readable_results(monkeypatch, bag, settings, tmp_path, capsys, error):
    class Stops(ScriptedMethod):
        def step(self, seen):
            if seen.stamp_ns == stamp(6):
                raise error
            return super().step(seen)

    monkeypatch.setattr("hat_ros.bench.runs.track.create_method", lambda *_: Stops())
    code = main(["track", str(bag), "--out", str(tmp_path / "out"), "--config", settings, "--quiet"])
    assert code == (130 if isinstance(error, KeyboardInterrupt) else 1)
    said = capsys.readouterr().err
    assert "partial" in said
    assert "Traceback" not in said
    left = tmp_path / "out.partial"
    assert not (tmp_path / "out").exists()
    assert json.loads((left / "metrics.json").read_text())["frames"] == 6
    assert len((left / "poses.csv").read_text().splitlines()) == 1 + 6

    from hat_ros.io.result_bag import read_result_bag

    assert len(read_result_bag(left / "bag")) == 6


def test_recording_without_a_usable_frame_is_a_failed_run(scripted, settings, tmp_path, capsys):
    model = tmp_path / "cubesat.glb"
    write_model("cubesat", model)
    with BagWriter(tmp_path / "bad", image_format="png") as writer:
        for i in range(3):
            writer.write_frame(stamp(i), b"\xff\xd8 no picture", CAMERA)
        writer.write_target(model)
    assert main(["track", str(tmp_path / "bad"), "--out", str(tmp_path / "out"), "--config", settings]) == 1
    assert "3 were refused" in capsys.readouterr().err


def test_doctor_knows_this_machine(capsys):
    assert main(["doctor"]) in (0, 1)
    text = capsys.readouterr().out
    assert "renderer" in text
    assert "presets" in text


def test_weights_list_names_source_and_licence(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["weights", "list"]) == 0
    text = capsys.readouterr().out
    assert "droid.pth" in text
    assert "BSD-3" in text


def test_temporal_answers_causally_or_over_the_whole_clip(tmp_path):
    scene = make_scene(40, noise_deg=3.0)
    np.savez(tmp_path / "obs.npz", **vars(scene.observations))
    for mode, run in (("hat", run_temporal), ("offline", run_offline)):
        command = ["temporal", str(tmp_path / "obs.npz"), "--config", "mega_hat", "--mode", mode]
        assert main([*command, "--out", str(tmp_path / f"{mode}.npz")]) == 0
        expected = run(scene.observations, load_config("mega_hat"))
        with np.load(tmp_path / f"{mode}.npz") as written:
            np.testing.assert_array_equal(written["T_cam_target"], expected.T_cam_target)
            assert {"T_cam_target", "chosen", "accepted", "resets"} <= set(written)


def test_frames_that_are_refused_are_counted_and_said(scripted, settings, tmp_path, capsys):
    """The clock steps back, then a second camera sends images of another size."""
    model = tmp_path / "cubesat.glb"
    write_model("cubesat", model)
    with BagWriter(tmp_path / "clip", image_format="png") as writer:
        for i in (0, 1, 2, 3, 4, 5, 1, 2):
            writer.write_frame(stamp(i), frame(i).rgb, CAMERA, T_cam_target=lie.matrix_from_row(true_row(i)))
        for i in (6, 7):
            writer.write_frame(stamp(i), frame(i).rgb[:20], CAMERA)
        writer.write_target(model)
    assert main(["track", str(tmp_path / "clip"), "--out", str(tmp_path / "out"), "--config", settings]) == 0
    said = capsys.readouterr()
    assert f"hat: refused 2 of 10 frames: frame {stamp(1)}: header.stamp must increase" in said.err
    assert f"hat: refused 2 of 10 frames: frame {stamp(6)}: image" in said.err
    assert "2 x frame" in said.out
    for name in ("metrics.json", "run.json"):
        found = json.loads((tmp_path / "out" / name).read_text())
        assert (found["refused"], [reason["count"] for reason in found["refused_reasons"]]) == (4, [2, 2]), name
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (figures["frames"], figures["dropped"], figures["valid"], figures["coverage"]) == (10, 0, 5, 0.5)
    assert "Frames refused" in (tmp_path / "out" / "report.html").read_text()
    assert main(["evaluate", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "metrics.json").read_text()) == figures


@pytest.mark.parametrize("command", ["track", "replay", "bench", "profile", "score"])
def test_what_a_camera_does_not_say_can_be_told(command):
    words = [command, "bag", "--rectified", "true", "--image-depth", "12"]
    words += [] if command == "profile" else ["--out", "out"]
    words += ["--poses", "poses.tum"] if command == "score" else []
    overrides = build_parser().parse_args(words).overrides
    camera = load_config("default", overrides).camera
    assert (camera.rectified, camera.image_depth) == ("true", "12")


@pytest.mark.parametrize("words", [["--rectified", "perhaps"], ["--image-depth", "7"], ["--image-depth", "true"]])
def test_another_word_for_the_camera_is_bad_input(words, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["track", "bag", "--out", "out", *words])
    assert stopped.value.code == 2
    assert "must be one of auto" in capsys.readouterr().err


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.ENOSPC])
def test_a_place_that_cannot_be_written_is_one_sentence(monkeypatch, capsys, number):
    def fails(arguments):
        raise OSError(number, os.strerror(number), "/mnt/cdrom/out.json")

    monkeypatch.setattr("hat_ros.cli.system._doctor", fails)
    assert main(["doctor"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "/mnt/cdrom/out.json" in said and os.strerror(number) in said


@pytest.mark.parametrize("name", ["x" * 300, "x/" * 3000])
@pytest.mark.parametrize(
    "words", [["track", "{}", "--out", "o"], ["check", "{}"], ["track", "bags/demo", "--out", "{}"], ["synth", "{}"]]
)
def test_a_path_that_is_too_long_is_one_sentence(capsys, name, words):
    words = [word.format(name) for word in words]
    assert main([*words, "--out", "o"] if words[0] == "synth" else words) == 2
    said = capsys.readouterr().err
    last = said.splitlines()[-1]  # a bar of progress may come before
    assert "Traceback" not in said and last.startswith("hat: ") and len(last) < 200 and "give a shorter path" in last


def test_other_errors_of_the_system_are_bugs_of_ours(monkeypatch):
    def fails(arguments):
        raise OSError(errno.EBADF, "Bad file descriptor", "x")

    monkeypatch.setattr("hat_ros.cli.system._doctor", fails)
    with pytest.raises(OSError, match="Bad file"):
        main(["doctor"])
