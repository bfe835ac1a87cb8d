"""A short clip through the five-process graph with every learned backend and rule-filled weights.

The poses mean nothing; that every frame is answered, recorded and written out does. What a keyframe costs on a CPU is
minutes with the published settings, so the clip has one keyframe and the template views are few.
"""

from __future__ import annotations

import csv
import json
import shutil

import numpy as np
import pytest
from graph_clip import said, status_column
from rosbags.rosbag2 import Reader

from hat_ros.bench.runs.replay import ReplayOptions, replay_bag
from hat_ros.config import load_config
from hat_ros.io import topics
from hat_ros.io.result_bag import read_result_bag
from hat_ros.io.rosbag import TYPESTORE
from hat_ros.ros.diagnostics import ERROR
from hat_ros.stages import create_backend
from hat_ros.target.loading import load_target

torch = pytest.importorskip("torch")

pytestmark = [pytest.mark.graph, pytest.mark.slow]

N_FRAMES = 6
FILES = {"metrics.json", "poses.csv", "poses.tum", "config.yaml", "run.json", "bag"}
GIVEN_MASKS = ("segmentation.backend=annotated",)
# One keyframe; DROID on 128 x 96 px, every frame a keyframe of its own, so that bundle adjustment runs as well.
SHORT = ("keyframes.gap_frames=100", "hypotheses.max_candidates=2", "hypotheses.megapose.refiner_iterations=1")
SMALL_DROID = ("slam.droid.input_area_px=12288", "slam.droid.warmup_keyframes=5", "slam.droid.filter_threshold=0")


@pytest.fixture
def learned(tmp_path, monkeypatch):
    """Rule weights by checkpoint name, written when asked for and removed afterwards: they are gigabytes."""
    from rule_weights import save_rule_weights, save_small_mask2former

    from hat_ros.nets.droid import DroidNet
    from hat_ros.nets.gigapose import GigaPoseNet
    from hat_ros.nets.megapose import CoarseNet, RefinerNet
    from hat_ros.nets.picopose import PicoPoseNet

    kinds = {
        "droid": DroidNet,
        "gigapose": GigaPoseNet,
        "megapose_coarse": CoarseNet,
        "megapose_refiner": RefinerNet,
        "picopose": PicoPoseNet,
    }
    folder = tmp_path / "weights"
    monkeypatch.setenv("HAT_WEIGHTS", str(folder))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def save(*names):
        for name in names:
            if name == "mask2former":
                save_small_mask2former(folder)
            else:
                save_rule_weights(folder, name, kinds[name]())

    yield save
    shutil.rmtree(folder, ignore_errors=True)
    shutil.rmtree(tmp_path / "cache", ignore_errors=True)


def prepare_few_templates(config, model, monkeypatch):
    """Encode 12 templates instead of 162, in this process; the nodes find them in the cache."""
    from hat_ros.target.sphere import look_inwards_upright

    few = look_inwards_upright(12)
    with monkeypatch.context() as patch:
        patch.setattr("hat_ros.hypotheses.picopose_templates.look_inwards_upright", lambda n_views: few)
        create_backend("hypotheses", config, load_target(model))


def replayed(bag, out, config, n_frames=N_FRAMES):
    """Replay, and check what holds whatever the numbers are; the result bag's topics."""
    options = ReplayOptions(limit=n_frames, video=False, report=False)
    folder = replay_bag(bag, out, config, options)
    assert {path.name for path in folder.iterdir()} >= FILES
    figures = json.loads((folder / "metrics.json").read_text())
    assert figures["frames"] == n_frames
    with (folder / "poses.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == n_frames
    found = said(folder / "bag")
    for topic in (topics.ADMISSION, topics.HYPOTHESES_SCORED, topics.SLAM_STATE, topics.SELECTION, topics.STATUS):
        assert len(found[topic]) == n_frames, f"{topic}: one message per frame"
    assert status_column(found, "seq") == list(range(n_frames))
    assert len(read_result_bag(folder / "bag")) == n_frames
    assert worst_diagnostics(folder / "bag") < ERROR, "waiting for a slow stage is a warning"
    return found


def worst_diagnostics(bag) -> int:
    levels = []
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            if connection.topic == topics.DIAGNOSTICS:
                message = TYPESTORE.deserialize_cdr(data, connection.msgtype)
                levels += [int(status.level) for status in message.status]
    assert levels
    return max(levels)


def candidates_per_frame(found) -> list[int]:
    n_columns = len(topics.CANDIDATE_COLUMNS)
    return [len(np.frombuffer(payload)) // n_columns for _, _, payload in found[topics.HYPOTHESES_SCORED]]


@pytest.fixture
def masked_bag(write_bag):
    return write_bag("masked", masks=True)


def test_mega_hat(masked_bag, learned, tmp_path):
    learned("megapose_coarse", "megapose_refiner", "droid")
    config = load_config("mega_hat", (*GIVEN_MASKS, *SHORT, *SMALL_DROID))
    found = replayed(masked_bag, tmp_path / "out", config)
    assert candidates_per_frame(found) == [2, 0, 0, 0, 0, 0]


def test_pico_hat(masked_bag, model, learned, tmp_path, monkeypatch):
    learned("picopose", "droid")
    config = load_config("pico_hat", (*GIVEN_MASKS, *SMALL_DROID, "keyframes.gap_frames=2"))
    prepare_few_templates(config, model, monkeypatch)
    found = replayed(masked_bag, tmp_path / "out", config)
    per_frame = candidates_per_frame(found)
    assert per_frame[0] == config.hypotheses.max_candidates
    assert sum(n > 0 for n in per_frame) >= 2


def test_gigapose_with_refinement(masked_bag, model, learned, tmp_path, monkeypatch):
    learned("gigapose", "megapose_coarse", "megapose_refiner")
    config = load_config("mega_hat", (*GIVEN_MASKS, *SHORT, "hypotheses.backend=gigapose", "slam.backend=feature"))
    prepare_few_templates(config, model, monkeypatch)
    found = replayed(masked_bag, tmp_path / "out", config)
    assert sum(candidates_per_frame(found)) <= 2


def test_mask2former(masked_bag, learned, tmp_path):
    learned("mask2former")
    overrides = ("segmentation.backend=mask2former", "segmentation.mask2former.min_score=0")
    config = load_config("default", (*overrides, "hypotheses.template.n_views=162"))
    replayed(masked_bag, tmp_path / "out", config, n_frames=14)
