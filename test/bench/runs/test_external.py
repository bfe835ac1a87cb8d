"""Poses of other methods: what is read, what is refused, and that they are scored like our own."""

import csv
import json

import numpy as np
import pytest
from scripted import CAMERA, frame, stamp, true_row

from hat_ros.bench.datasets.pose_files import read_poses
from hat_ros.bench.evaluation.result_folder import evaluate_folder
from hat_ros.bench.experiments.comparison import bench_jobs, bench_table, clips_named
from hat_ros.bench.experiments.run_matrix import run_jobs
from hat_ros.bench.runs.external import ScoreOptions, match_stamps, score_poses
from hat_ros.bench.source import SourceSpec
from hat_ros.bench.synth.models import write_model
from hat_ros.cli import main
from hat_ros.errors import InputError, UsageError
from hat_ros.geometry import lie
from hat_ros.io.bag_writer import BagWriter
from hat_ros.io.results import METRICS_FILE, RUN_FILE, tum_line

N = 6
QUIET = {"video": False, "report": False}


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("external") / "clip"
    model = folder.parent / "cubesat.glb"
    write_model("cubesat", model)
    with BagWriter(folder, image_format="png") as writer:
        for i in range(N):
            writer.write_frame(stamp(i), frame(i).rgb, CAMERA, T_cam_target=lie.matrix_from_row(true_row(i)))
        writer.write_target(model)
    return folder


def tum(path, frames=range(N), change=lambda row: row, shift_ns=0):
    path.write_text("# stamp x y z qx qy qz qw\n" + "".join(
        tum_line(stamp(i) + shift_ns, change(true_row(i))) for i in frames
    ))  # fmt: skip
    return path


def figures(folder):
    return json.loads((folder / METRICS_FILE).read_text())


def test_the_truth_scores_zero_and_missing_frames_count_against_coverage(bag, tmp_path):
    poses = tum(tmp_path / "poses.tum", frames=[0, 1, 2, 4])
    folder = score_poses(SourceSpec(bag), poses, tmp_path / "out", ScoreOptions(method="other", fps=7.5, **QUIET))
    scored = figures(folder)
    assert scored["E_p_mean"] == pytest.approx(0.0, abs=1e-9)
    assert (scored["targets"], scored["valid"], scored["state_lost"], scored["fps"]) == (N, 4, 2, 7.5)
    with (folder / "poses.csv").open() as file:
        assert [row["E_p"] == "" for row in csv.DictReader(file)] == [False, False, False, True, False, True]
    run = json.loads((folder / RUN_FILE).read_text())
    assert (run["mode"], run["config_sha256"], run["poses_unmatched"]) == ("other", None, 0)
    assert len(run["poses_sha256"]) == 64


def test_errors_are_those_of_a_run_of_ours(bag, tmp_path):
    def off(row):
        return np.concatenate([row[:3] + [0.0, 0.0, 0.1], row[3:]])

    folder = score_poses(
        SourceSpec(bag), tum(tmp_path / "p.txt", change=off), tmp_path / "out", ScoreOptions(method="x")
    )
    scored = figures(folder)
    assert scored["E_t_m_mean"] == pytest.approx(0.1)
    assert scored["E_q_deg_mean"] == pytest.approx(0.0, abs=1e-6)
    assert (folder / "report.html").is_file()
    before = figures(folder)
    evaluate_folder(folder)
    assert figures(folder) == before


def test_stamps_that_lost_their_last_digits_still_match_and_others_do_not():
    rows = {stamp(0) + 400: np.ones(7), stamp(1) - 900_000: np.full(7, 2.0), stamp(1): np.full(7, 3.0)}
    rows |= {stamp(3) + 2_000_000: np.full(7, 4.0)}
    matched = match_stamps([stamp(i) for i in range(4)], rows)
    assert {s: row[0] for s, row in matched.items()} == {stamp(0): 1.0, stamp(1): 3.0}
    assert match_stamps([stamp(0)], {}) == {}


def test_missing_files_and_other_recordings_are_refused(bag, tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_poses(tmp_path / "nothing.tum")
    with pytest.raises(InputError, match="none lies within 1 ms"):
        far = tum(tmp_path / "far.tum", shift_ns=10**12)
        score_poses(SourceSpec(bag), far, tmp_path / "out", ScoreOptions(method="x", **QUIET))
    assert not (tmp_path / "out").exists()


def test_the_command_writes_a_run_and_a_bench_takes_the_file_as_a_row(bag, tmp_path, capsys):
    poses = tum(tmp_path / "clip.tum", change=lambda row: row * [1.01, 1.01, 1.01, 1, 1, 1, 1])
    score = ["score", str(bag), "--poses", str(poses), "--method", "rgbtrack", "--no-video"]
    assert main([*score, "--out", str(tmp_path / "out")]) == 0
    assert "pose error" in capsys.readouterr().out
    externals = {"rgbtrack": f"{tmp_path}/{{clip}}.tum"}
    jobs = bench_jobs(clips_named([str(bag)]), ["hat"], ["own"], [0], "default", limit=3, externals=externals)
    assert [(job.labels["mode"], job.labels["masks"]) for job in jobs] == [("hat", "own"), ("rgbtrack", "-")]
    first, again = (run_jobs(jobs[1:], tmp_path / "bench") for _ in range(2))
    assert again[0].reused
    row = bench_table(first).rows[0]
    assert (row["mode"], row["E_p_mean"]) == ("rgbtrack", pytest.approx(0.01))


def test_another_file_of_poses_is_another_run(bag, tmp_path):
    def job(path, name="rgbtrack"):
        return bench_jobs(clips_named([str(bag)]), ["hat"], ["own"], [0], "default", externals={name: str(path)})[1]

    a, b = tum(tmp_path / "a.tum"), tum(tmp_path / "b.tum", frames=range(3))
    assert job(a).fingerprint() != job(b).fingerprint()
    assert job(a).fingerprint() == job(a).fingerprint()
    with pytest.raises(UsageError, match="does not exist"):
        job(tmp_path / "c.tum")
    with pytest.raises(UsageError, match="two methods are called hat"):
        job(a, "hat")
