"""``hat campaign`` as people type it."""

import json

import pytest
from campaign_results import result

from hat_ros.bench.campaign import run
from hat_ros.bench.synth.models import write_model
from hat_ros.cli import main


@pytest.fixture
def played(monkeypatch):
    """No clip is played: every other one is found. Yields the tasks."""
    tasks = []

    def scripted(given, n_jobs, watch):
        tasks.extend(given)
        names = tuple(dict.fromkeys(task.craft.name for task in given))
        results = [
            result(i, found=i % 2 == 0, on_map=given[0].clip.cell is not None, crafts=names) for i in range(len(given))
        ]
        for item in results:
            watch(item)
        return results

    monkeypatch.setattr(run, "run_clips", scripted)
    return tasks


def test_generated_craft_without_a_cad(played, tmp_path, capsys):
    assert main(["campaign", "--clips", "24", "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert len({task.craft.name for task in played}) == 12
    assert "24  50 (31-69)" in capsys.readouterr().out
    told = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert (told["seed"], told["clips"], told["masks"]) == (1, 24, "own")


def test_a_cad_with_a_camera_and_given_masks(played, tmp_path):
    cad = tmp_path / "probe.glb"
    write_model("probe", cad)
    words = [
        "--size",
        "320",
        "240",
        "--focal",
        "500",
        "--frames",
        "7",
        "--masks",
        "given",
        "--clips",
        "2",
        "--jobs",
        "2",
    ]
    assert main(["campaign", str(cad), "--out", str(tmp_path / "out"), *words]) == 0
    film = played[0].clip.film
    assert (film.width, film.height, film.focal_px, film.frames) == (320, 240, 500, 7)
    assert [task.craft.name for task in played] == ["probe", "probe"]
    assert played[0].masks_given
    assert played[0].config.segmentation.backend == "annotated"


def test_map(played, tmp_path):
    assert main(["campaign", "--generated", "1", "--map", "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert len(played) == 3 * 44
    assert (tmp_path / "out" / "map.png").is_file()


def test_clips_that_fail_are_said_and_the_exit_code_is_1(monkeypatch, tmp_path, capsys):
    from campaign_results import failed

    monkeypatch.setattr(run, "run_clips", lambda tasks, jobs, watch: [failed(0, "MeshError: gone")])
    assert main(["campaign", "--generated", "1", "--clips", "1", "--out", str(tmp_path / "out"), "--quiet"]) == 1
    assert "failed: clip 000000: MeshError: gone" in capsys.readouterr().err


def test_reports_of_what_lies_there(monkeypatch, tmp_path, capsys):
    results = {"a": [result(0), result(1)], "b": [result(0, found=True), result(1)]}
    monkeypatch.setattr(run, "read_results", lambda out: results[out.name])
    for name in results:
        (tmp_path / name).mkdir()
    assert main(["campaign", "--report-only", "--out", str(tmp_path / "a")]) == 0
    assert (tmp_path / "a" / "report.html").is_file()
    assert main(["campaign", "--compare", str(tmp_path / "a"), str(tmp_path / "b")]) == 0
    assert "won: 1\n  000000 " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "--out is missing"),
        (["--out", "{tmp}/out", "--generated", "0"], "no craft"),
        (["{tmp}/none.glb", "--out", "{tmp}/out"], "no such file"),
        (["--out", "{tmp}/out", "--focal", "0"], "--focal must be positive"),
        (["--out", "{tmp}/out", "--set", "magic=1"], "magic"),
        (["--out", "{tmp}"], "current folder"),
    ],
)
def test_bad_input_is_one_sentence(words, sentence, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["campaign", *(word.format(tmp=tmp_path) for word in words)]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1


def test_a_folder_without_results_is_said(tmp_path, capsys):
    assert main(["campaign", "--report-only", "--out", str(tmp_path / "none")]) == 1
    assert "holds no results" in capsys.readouterr().err
