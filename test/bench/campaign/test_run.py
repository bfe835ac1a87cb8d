"""Clips are played once, kept with what determines them, and fail alone."""

import json
import os
from dataclasses import replace

import cv2
import numpy as np
import pytest

from hat_ros.bench.campaign import run
from hat_ros.bench.campaign.crafts import Craft
from hat_ros.bench.campaign.draw import View, draw_clip
from hat_ros.bench.campaign.play import compressed, film_clip
from hat_ros.bench.campaign.run import Task, play_task, read_results, run_clips
from hat_ros.bench.synth.models import write_model
from hat_ros.config import load_config
from hat_ros.errors import RunError

FRAMES = 3
CONFIG = load_config("default", ["segmentation.backend=annotated"])


@pytest.fixture(scope="module")
def craft(tmp_path_factory):
    path = tmp_path_factory.mktemp("craft") / "probe.glb"
    write_model("probe", path)
    return Craft("probe", path)


def small(index, craft, out, **more):
    clip = draw_clip(1, index, (craft.name,), View(FRAMES, 160, 120, 250.0))
    return Task(clip, craft, CONFIG, True, out, **more)


@pytest.fixture(scope="module")
def campaign(craft, tmp_path_factory):
    """Two clips and one whose craft cannot be loaded, through worker processes."""
    out = tmp_path_factory.mktemp("campaign") / "out"
    broken = craft.path.with_name("broken.glb")
    write_model("probe", broken)
    tasks = [small(0, craft, out), small(1, craft, out), small(2, Craft("broken", broken), out)]
    prints = [task.fingerprint() for task in tasks]
    broken.write_bytes(b"no CAD file")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Task, "fingerprint", lambda task: prints[task.clip.index])
        seen = []
        results = run_clips(tasks, 1, seen.append)
    return out, tasks, results, seen


def test_clips_come_in_order_with_their_figures(campaign):
    _, _, results, seen = campaign
    assert [result.index for result in results] == [0, 1, 2]
    assert sorted(result.index for result in seen) == [0, 1, 2]
    for result in results[:2]:
        assert not result.failure
        assert result.figures["frames"] == FRAMES
        assert len(result.series["e_p"]) == len(result.series["frame_ms"]) == FRAMES
        assert result.figures["mask_iou_sum"] == result.figures["masks"]  # masks were given


def test_a_clip_that_raises_is_not_found_and_stops_none(campaign):
    out, _, results, _ = campaign
    assert "broken.glb" in results[2].failure
    assert results[2].failure.startswith("MeshError: ")
    assert not results[2].figures["found"]
    assert (out / "clips" / "000002.log").is_file()


def test_what_is_done_is_used_again(campaign, monkeypatch):
    _, tasks, results, _ = campaign
    monkeypatch.setattr(run, "ProcessPoolExecutor", None)  # nothing may be played
    again = run_clips(tasks[:2], 1, lambda result: None)
    assert all(result.reused for result in again)
    assert [replace(result, reused=False) for result in again] == results[:2]


@pytest.mark.parametrize("what", ["code", "config", "masks", "clip"])
def test_what_determines_a_result_makes_it_anew(campaign, craft, monkeypatch, what):
    _, tasks, _, _ = campaign
    task = tasks[0]
    if what == "code":
        monkeypatch.setattr(run, "code_hash", lambda: "other")
    elif what == "config":
        task = replace(task, config=load_config("default"))
    elif what == "masks":
        task = replace(task, masks_given=False)
    else:
        task = replace(task, clip=replace(task.clip, film=replace(task.clip.film, noise=0.02)))
    played = []

    def scripted(todo, n_jobs):
        played.extend(todo)
        return iter([replace(campaign[2][0], reused=False)])

    monkeypatch.setattr(run, "_played", scripted)
    run_clips([task], 1, lambda result: None)
    assert [item[0].clip.index for item in played] == [0]


def test_results_are_read_back(campaign, tmp_path):
    out, _, results, _ = campaign
    assert read_results(out) == results
    with pytest.raises(RunError, match="holds no results"):
        read_results(tmp_path)
    (tmp_path / "clips").mkdir()
    (tmp_path / "clips" / "000000.json").write_text("{", encoding="utf-8")
    with pytest.raises(RunError, match=r"000000\.json cannot be read"):
        read_results(tmp_path)


def test_kept_images_are_those_that_were_tracked(craft, tmp_path, monkeypatch):
    task = small(4, craft, tmp_path, keep=True)
    (tmp_path / "clips").mkdir()
    result = play_task(task, task.fingerprint())
    assert not result.failure
    film = film_clip(task.clip, craft.load())
    labels = json.loads((task.kept / "labels.json").read_text(encoding="utf-8"))
    assert (task.kept / labels["mesh"]).is_file()
    names = sorted(path for path in (task.kept / "images").iterdir())
    for path, frame in zip(names, film.frames, strict=True):
        assert np.array_equal(cv2.imread(str(path))[..., ::-1], frame.rgb)
        mask = cv2.imread(str(task.kept / "masks" / f"{path.stem}.png"), cv2.IMREAD_GRAYSCALE)
        assert np.array_equal(mask, frame.given_mask)


def test_a_generated_craft_is_kept_with_a_model(tmp_path):
    task = small(0, Craft("generated-0", seed=1_000_000), tmp_path, keep=True)
    run._keep(task)
    assert (task.kept / "target.glb").is_file()


def test_compression():
    rgb = np.random.default_rng(0).integers(0, 255, (32, 48, 3), dtype=np.uint8)
    assert compressed(rgb, 0) is rgb
    good, poor = (np.abs(compressed(rgb, quality).astype(int) - rgb).mean() for quality in (97, 60))
    assert 0 < good < poor
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 200
    assert compressed(red, 97)[8, 8, 0] > 190  # channels keep their places


def test_a_campaign_that_is_stopped_keeps_what_is_done_and_goes_on(craft, tmp_path):
    tasks = [small(index, craft, tmp_path) for index in range(3)]

    def stop(result):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_clips(tasks, 1, stop)
    done = [result.index for result in read_results(tmp_path)]
    assert done == [0, 1]  # the second one was being played
    results = run_clips(tasks, 1, lambda result: None)
    assert [result.reused for result in results] == [True, True, False]


def dies(task, fingerprint):
    os._exit(1)


def test_a_worker_that_is_killed_is_one_sentence(craft, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "play_task", dies)
    monkeypatch.setattr(Task, "fingerprint", lambda task: {})
    with pytest.raises(RunError, match="a worker process was killed"):
        run_clips([small(0, craft, tmp_path)], 1, lambda result: None)
