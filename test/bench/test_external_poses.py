"""Poses of other methods: what is read, what is refused, and that they are scored like our own."""

import csv
import json

import numpy as np
import pytest
from scripted import CAMERA, frame, stamp, true_row

from hat_ros.bench.datasets.image_files import stamp_of
from hat_ros.bench.evaluation.folder import evaluate_folder
from hat_ros.bench.experiments.comparison import bench_jobs, bench_table, clips_named
from hat_ros.bench.experiments.run_matrix import run_jobs
from hat_ros.bench.external_poses import ScoreOptions, match_stamps, read_poses, score_poses
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


def bop_line(image, row, score=1.0, time=-1.0, scene=1, obj=2):
    T = lie.matrix_from_row(row)
    R, t = (" ".join(repr(float(x)) for x in values) for values in (T[:3, :3].ravel(), 1000 * T[:3, 3]))
    return f"{scene},{image},{obj},{score},{R},{t},{time}\n"


def bop(path, *lines):
    path.write_text("scene_id,im_id,obj_id,score,R,t,time\n" + "".join(lines))
    return path


def figures(folder):
    return json.loads((folder / METRICS_FILE).read_text())


def test_the_truth_scores_zero_and_missing_frames_count_against_coverage(bag, tmp_path):
    poses = tum(tmp_path / "poses.tum", frames=[0, 1, 2, 4])
    folder = score_poses(SourceSpec(bag), poses, tmp_path / "out", ScoreOptions("other", fps=7.5, **QUIET))
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

    folder = score_poses(SourceSpec(bag), tum(tmp_path / "p.txt", change=off), tmp_path / "out", ScoreOptions("x"))
    scored = figures(folder)
    assert scored["E_t_m_mean"] == pytest.approx(0.1)
    assert scored["E_q_deg_mean"] == pytest.approx(0.0, abs=1e-6)
    assert (folder / "report.html").is_file()
    before = figures(folder)
    evaluate_folder(folder)
    assert figures(folder) == before


def test_stamps_that_lost_their_last_digits_still_match_and_strangers_do_not():
    rows = {stamp(0) + 400: np.ones(7), stamp(1) - 900_000: np.full(7, 2.0), stamp(1): np.full(7, 3.0)}
    rows |= {stamp(3) + 2_000_000: np.full(7, 4.0)}
    matched = match_stamps([stamp(i) for i in range(4)], rows)
    assert {s: row[0] for s, row in matched.items()} == {stamp(0): 1.0, stamp(1): 3.0}
    assert match_stamps([stamp(0)], {}) == {}


def test_bop_files_are_in_millimetres_and_the_best_score_counts(tmp_path):
    wrong = true_row(0) + [1, 0, 0, 0, 0, 0, 0]
    path = bop(
        tmp_path / "x.csv",
        bop_line(3, wrong, score=0.2, time=0.5),
        bop_line(3, true_row(0), score=0.9, time=0.5),
        bop_line(5, true_row(1), time=0.25),
    )
    poses = read_poses(path)
    assert sorted(poses.rows) == [stamp_of(3), stamp_of(5)]
    np.testing.assert_allclose(
        lie.matrix_from_row(poses.rows[stamp_of(3)]), lie.matrix_from_row(true_row(0)), atol=1e-9
    )
    assert sorted(poses.seconds) == [0.25, 0.5], "an image's time counts once"


def test_of_a_bop_file_with_several_objects_only_the_recordings_counts(tmp_path):
    path = bop(tmp_path / "x.csv", bop_line(3, true_row(0)), bop_line(3, true_row(1), obj=7, score=9.0))
    rows = read_poses(path, scene=(1, 7)).rows
    np.testing.assert_allclose(rows[stamp_of(3)][:3], true_row(1)[:3])
    with pytest.raises(InputError, match="2 scenes or objects"):
        read_poses(path)
    with pytest.raises(InputError, match="no pose of scene"):
        read_poses(path, scene=(9, 9))


def test_a_folder_of_matrices_is_read_by_frame_number(bag, tmp_path):
    poses = tmp_path / "ob_in_cam"
    poses.mkdir()
    for i in range(N):
        np.savetxt(poses / f"{i:06d}.txt", lie.matrix_from_row(true_row(i)))
    rows = read_poses(poses).rows
    assert sorted(rows) == [stamp_of(i) for i in range(N)]
    np.testing.assert_allclose(rows[stamp_of(2)], true_row(2), atol=1e-12)
    np.savetxt(poses / "000003.txt", 2 * np.eye(4))
    with pytest.raises(InputError, match=r"000003.txt: the matrix is no rigid"):
        read_poses(poses)
    np.savetxt(poses / "000003.txt", np.eye(3))
    with pytest.raises(InputError, match="expected 16 finite numbers"):
        read_poses(poses)
    (poses / "000003.txt").rename(poses / "frame3.txt")
    with pytest.raises(InputError, match="must be the frame's number"):
        read_poses(poses)


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("a.tum", "", "holds no pose"),
        ("a.tum", "1.0 0 0 5 0 0 0\n", "line 1: expected stamp"),
        ("a.tum", "1.0 0 0 5 0 0 0 2\n", "length 2.0000"),
        ("a.tum", "1.0 0 0 nan 0 0 0 1\n", "finite"),
        ("a.tum", "\n# x\nsoon 0 0 5 0 0 0 1\n", "line 3: 'soon' is no time"),
        ("a.csv", "im_id,R\n1,2\n", "expected the columns scene_id,im_id"),
        ("a.csv", "scene_id,im_id,obj_id,score,R,t,time\n1,x,2,1,0,0,0\n", "line 2: .*whole numbers"),
        ("a.csv", "scene_id,im_id,obj_id,score,R,t,time\n1,1,2,1,1 0 0,0 0 5,0\n", "expected 9 finite numbers"),
        ("a.csv", "scene_id,im_id,obj_id,score,R,t,time\n1,1,2,1,2 0 0 0 1 0 0 0 1,0 0 5,0\n", "not a rotation"),
    ],
)
def test_malformed_files_are_refused_with_the_line(tmp_path, name, text, complaint):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=complaint):
        read_poses(tmp_path / name)


def test_missing_files_and_other_recordings_are_refused(bag, tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_poses(tmp_path / "nothing.tum")
    with pytest.raises(InputError, match="none lies within 1 ms"):
        far = tum(tmp_path / "far.tum", shift_ns=10**12)
        score_poses(SourceSpec(bag), far, tmp_path / "out", ScoreOptions("x", **QUIET))
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
