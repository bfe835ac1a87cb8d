"""Many runs: resumable, isolated failures, tables with the same bytes."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from scripted import CAMERA, frame, stamp, true_row

from hat_ros.bench.experiments import run_matrix
from hat_ros.bench.experiments.comparison import (
    Entry,
    bench_jobs,
    bench_table,
    clips_named,
    clips_of_suite,
    failures,
    group_table,
    stage_table,
)
from hat_ros.bench.experiments.run_matrix import Job, run_jobs
from hat_ros.bench.synth.models import write_model
from hat_ros.errors import UsageError
from hat_ros.geometry import lie
from hat_ros.io.bag_writer import BagWriter
from hat_ros.io.results import METRICS_FILE, RUN_FILE


@pytest.fixture
def clips(tmp_path):
    model = tmp_path / "cubesat.glb"
    write_model("cubesat", model)
    for name in ("one", "two"):
        with BagWriter(tmp_path / name, image_format="png") as writer:
            for i in range(3):
                T = lie.matrix_from_row(true_row(i))
                writer.write_frame(stamp(i), frame(i).rgb, CAMERA, T_cam_target=T)
            writer.write_target(model)
    (tmp_path / "settings.yaml").write_text("keyframes: {gap_frames: 6}\n")
    return [str(tmp_path / "one"), str(tmp_path / "two")]


@pytest.fixture
def fake_runs(monkeypatch):
    """Runs that take no time: each writes what a real one would write; `log` counts them, `broken` fails."""
    log: list[str] = []
    broken: set[str] = set()

    class Done:
        def __init__(self, returncode, stderr):
            self.returncode, self.stderr = returncode, stderr

    def run(command, **_):
        folder = Path(command[command.index("--out") + 1])
        log.append(folder.name)
        if folder.name in broken:
            return Done(2, "Traceback ...\nhat: the bag is damaged\n")
        folder.mkdir(parents=True, exist_ok=True)
        job = next(job for job in jobs_by_name.values() if job.name == folder.name)
        (folder / RUN_FILE).write_text(json.dumps(job.fingerprint()))
        figures = {"frames": 3, "targets": 3, "valid": 2, "E_p_mean": len(log) / 10, "fps": 20.0 + len(log)}
        errors = "E_t_m,E_q_deg,E_p\n0.1,2.0,0.05\n0.3,4.0,0.15\n,,\n"
        (folder / "poses.csv").write_text(errors)
        (folder / METRICS_FILE).write_text(json.dumps(figures))
        return Done(0, "")

    jobs_by_name: dict[str, Job] = {}
    monkeypatch.setattr(run_matrix, "subprocess", SimpleNamespace(run=run))
    return log, broken, jobs_by_name


def make(clips, registry, **options):
    settings = {"modes": ["hat", "independent"], "masks": ["own"], "starts": [0]} | options
    settings.setdefault("config", str(Path(clips[0]).parent / "settings.yaml"))
    jobs = bench_jobs(clips_named(clips), **settings)
    registry.update({job.name: job for job in jobs})
    return jobs


def test_jobs_cover_every_combination_once(clips):
    named, modes, masks = clips_named(clips), ["hat", "independent"], ["own", "given"]
    jobs = bench_jobs(named, modes, masks, [0, 60], "default", ["keyframes.gap_frames=3"])
    assert len(jobs) == len({job.name for job in jobs}) == 2 * 2 * 2 * 2
    given = [job for job in jobs if job.labels["masks"] == "given"]
    assert all("segmentation.backend=annotated" in job.overrides for job in given)
    assert all("keyframes.gap_frames=3" in job.overrides for job in jobs)
    assert {job.start for job in jobs} == {0, 60}


def test_one_clip_may_have_settings_of_its_own(clips):
    named = clips_named([clips[0], f"{clips[1]}@slam.masked=false,keyframes.gap_frames=2"])
    jobs = bench_jobs(named, ["hat"], ["own"], [0], "default")
    assert jobs[0].overrides == ()
    assert jobs[1].overrides == ("slam.masked=false", "keyframes.gap_frames=2")


def test_patterns_name_many_clips_with_the_same_settings(clips):
    named = clips_named([f"{Path(clips[0]).parent}/*@slam.masked=false"])
    assert [(spec.name, settings) for spec, settings in named if spec.path.is_dir()] == [
        ("one", ("slam.masked=false",)),
        ("two", ("slam.masked=false",)),
    ]


def test_methods_have_names_and_configurations_of_their_own(clips):
    told = ("Mega-HAT=hat:mega_hat", "GigaPose=independent:mega_hat,hypotheses.backend=gigapose", "Ours=hat")
    methods = [Entry.parse(text, "default") for text in told]
    jobs = bench_jobs(clips_named(clips[:1]), ["srt3d"], ["own"], [0], "default", methods=methods)
    found = {job.labels["mode"]: job for job in jobs}
    assert [*found] == ["srt3d", "Mega-HAT", "GigaPose", "Ours"]
    assert (found["Mega-HAT"].mode, found["Mega-HAT"].config) == ("hat", "mega_hat")
    assert found["GigaPose"].overrides == ("hypotheses.backend=gigapose",)
    assert found["Ours"].config == "default"


@pytest.mark.parametrize("text", ["Mega-HAT", "=hat", "a/b=hat", "x=magic", "x=hat:default,gap"])
def test_malformed_methods_are_refused(text):
    with pytest.raises(UsageError, match="--method"):
        Entry.parse(text, "default")


def test_two_methods_of_one_name_are_refused(clips):
    with pytest.raises(UsageError, match="two methods are called hat"):
        bench_jobs(clips_named(clips), ["hat"], ["own"], [0], "default", methods=[Entry("hat", "hat", "mega_hat")])


def test_suite_clips_come_with_the_settings_of_their_group(tmp_path):
    for group, name in (("ycbv", "ycbv_probe"), ("spark", "spark_observer"), ("spark", "of_no_suite")):
        (tmp_path / group / name).mkdir(parents=True)
    named = clips_of_suite(tmp_path)
    assert [spec.name for spec, _ in named] == ["spark_observer", "ycbv_probe"]
    jobs = bench_jobs(named, ["hat"], ["own", "given"], [0], "default")
    told = [(job.labels["group"], job.labels["masks"]) for job in jobs]
    assert told == [("spark", "own"), ("spark", "given"), ("ycbv", "given")]
    assert "slam.masked=false" in jobs[2].overrides
    with pytest.raises(UsageError, match="hat synth suite"):
        clips_of_suite(tmp_path / "spark")


def test_missing_or_ambiguous_clips_are_refused(clips, tmp_path):
    with pytest.raises(UsageError, match="no such file"):
        bench_jobs(clips_named([str(tmp_path / "three")]), ["hat"], ["own"], [0], "default")
    with pytest.raises(UsageError, match="two recordings are called one"):
        bench_jobs(clips_named([clips[0], clips[0]]), ["hat"], ["own"], [0], "default")


def test_killed_and_resumed_run_matrix_gives_the_same_table_byte_for_byte(clips, fake_runs, tmp_path, monkeypatch):
    log, _, registry = fake_runs
    jobs = make(clips, registry)
    out = tmp_path / "bench"

    one_run = run_matrix.subprocess.run

    def killed(command, **options):
        if len(log) == 2:
            raise KeyboardInterrupt
        return one_run(command, **options)

    monkeypatch.setattr(run_matrix.subprocess, "run", killed)
    with pytest.raises(KeyboardInterrupt):
        run_jobs(jobs, out)
    assert len(log) == 2
    monkeypatch.setattr(run_matrix.subprocess, "run", one_run)
    first = run_jobs(jobs, out)
    assert len(log) == len(jobs), "what was done is used again"
    again = run_jobs(jobs, out, n_jobs=3)
    assert len(log) == len(jobs)
    assert all(outcome.reused for outcome in again)
    for table in (bench_table, stage_table, group_table):
        assert table(first).csv() == table(again).csv()
        assert table(first).text() == table(again).text()


def test_failure_is_isolated_and_listed(clips, fake_runs, tmp_path):
    log, broken, registry = fake_runs
    jobs = make(clips, registry)
    broken.add(jobs[1].name)
    outcomes = run_jobs(jobs, tmp_path / "bench", n_jobs=2)
    assert [outcome.figures is None for outcome in outcomes] == [False, True, False, False]
    assert failures(outcomes) == [f"{jobs[1].name}: hat: the bag is damaged"]
    assert "Traceback" in (tmp_path / "bench" / "runs" / f"{jobs[1].name}.log").read_text()
    assert len(bench_table(outcomes).rows) == 4
    broken.clear()
    run_jobs(jobs, tmp_path / "bench")
    assert len(log) == len(jobs) + 1, "only the failed one runs again"


@pytest.mark.parametrize("change", ["config", "limit", "recording", "code"])
def test_a_run_is_used_again_only_if_nothing_that_decides_it_changed(clips, fake_runs, tmp_path, monkeypatch, change):
    log, _, registry = fake_runs
    run_jobs(make(clips[:1], registry, modes=["hat"]), tmp_path / "bench")
    options = {"modes": ["hat"]}
    if change == "config":
        options["overrides"] = ["keyframes.gap_frames=9"]
    elif change == "limit":
        options["limit"] = 2
    elif change == "recording":
        (Path(clips[0]) / "note.txt").write_text("touched")
        run_matrix._sha256.cache_clear()
    else:
        monkeypatch.setattr(run_matrix, "code_hash", lambda: "other code")
    run_jobs(make(clips[:1], registry, **options), tmp_path / "bench")
    assert len(log) == 2


def test_each_row_leads_to_its_run_folder(clips, fake_runs, tmp_path):
    _, _, registry = fake_runs
    outcomes = run_jobs(make(clips, registry), tmp_path / "bench")
    for row in bench_table(outcomes).rows:
        run = json.loads((tmp_path / "bench" / row["run"] / RUN_FILE).read_text())
        assert {"source_sha256", "config_sha256", "code_sha256"} <= set(run)


def test_groups_pool_frames_and_count_missing_outputs(clips, fake_runs, tmp_path):
    _, _, registry = fake_runs
    outcomes = run_jobs(make(clips, registry, modes=["hat"]), tmp_path / "bench")
    (row,) = group_table(outcomes).rows
    assert (row["clips"], row["targets"]) == (2, 6)
    assert row["coverage"] == pytest.approx(4 / 6)
    assert row["E_q_deg_mean"] == pytest.approx(3.0)
    assert row["E_p_sd"] == pytest.approx(0.0577, abs=1e-4)
    assert row["fps"] == pytest.approx(6 / (3 / 21 + 3 / 22))


def test_graph_runs_go_through_replay_and_compare_with_track(clips):
    (job,) = bench_jobs(clips_named(clips[:1]), ["graph"], ["own"], [0], "default")
    assert "replay" in job.command(Path("out"))
    assert "--mode" not in job.command(Path("out"))
    assert job.fingerprint()["mode"] == "hat"


def test_bad_configuration_is_found_before_anything_runs(clips, fake_runs, tmp_path):
    from hat_ros.errors import ConfigError

    log, _, _ = fake_runs
    jobs = make(clips, {}, overrides=["keyframes.gap=3"])
    with pytest.raises(ConfigError, match="gap_frames"):
        run_jobs(jobs, tmp_path / "bench")
    assert log == []


@pytest.mark.slow
def test_real_runs_two_at_a_time(clips, tmp_path):
    jobs = make(clips, {}, modes=["independent"], limit=1, overrides=["segmentation.backend=classical"])
    outcomes = run_jobs(jobs, tmp_path / "bench", n_jobs=2)
    assert failures(outcomes) == []
    assert [outcome.figures["frames"] for outcome in outcomes] == [1, 1]
