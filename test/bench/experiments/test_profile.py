"""What a profile says: every frame attributed, and the passes and renders of MegaPose."""

import json
import sys

import numpy as np
import pytest

from hat_ros.app.timing import STAGE_NAMES
from hat_ros.bench.experiments.profile import profile
from hat_ros.bench.source import open_source
from hat_ros.bench.synth.clips import ClipSpec
from hat_ros.bench.synth.suite import Clip, synthesize
from hat_ros.cli import main
from hat_ros.config import load_config
from hat_ros.errors import MissingDependencyError, UsageError

N_FRAMES, GAP = 7, 3


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    spec = ClipSpec(frames=N_FRAMES, width=160, height=120, focal_px=260.0, range_m=(8.0, 7.0), supersample=1)
    return synthesize(Clip("observer", spec), tmp_path_factory.mktemp("profile") / "clip", False)


def test_a_missing_package_is_one_sentence(clip, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    config = load_config("default", ["hypotheses.backend=megapose"])
    with pytest.raises(MissingDependencyError, match=r"'torch'.*make install-nets"):
        profile(open_source(clip), config)


def test_stages_of_every_frame_are_attributed(clip):
    config = load_config("default", ["hypotheses.template.n_views=162", f"keyframes.gap_frames={GAP}"])
    seen = []
    measured = profile(open_source(clip), config, watch=lambda done, total, state: seen.append((done, total)))
    assert seen == [(index + 1, N_FRAMES) for index in range(N_FRAMES)]
    later = measured.n_keyframes + measured.n_between
    assert measured.n_keyframes >= 1 and later < N_FRAMES
    assert measured.start["segmentation"].calls + later == N_FRAMES
    for stage in STAGE_NAMES:
        assert measured.keyframe[stage].calls == measured.between[stage].calls == 1
    assert measured.keyframe["hypotheses"].seconds > measured.between["hypotheses"].seconds
    assert measured.fps > 0 and np.isnan(measured.device_memory_mib) and measured.host_memory_mib > 1


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_megapose_passes_and_renders_add_up(clip, tmp_path, monkeypatch, device):
    torch = pytest.importorskip("torch")
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs CUDA")
    from rule_weights import save_rule_weights

    from hat_ros.hypotheses import megapose
    from hat_ros.nets.megapose import CoarseNet, RefinerNet

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    save_rule_weights(tmp_path, "megapose_coarse", CoarseNet())
    save_rule_weights(tmp_path, "megapose_refiner", RefinerNet())
    n_grid, n_candidates, n_iterations = 3, 2, 1
    monkeypatch.setattr(megapose, "so3_grid", lambda level: np.eye(4)[1:])
    settings = {
        "hypotheses.backend": "megapose",
        "hypotheses.max_candidates": n_candidates,
        "hypotheses.megapose.refiner_iterations": n_iterations,
        "segmentation.backend": "annotated",
        "keyframes.gap_frames": GAP,
        "nets.weights_folder": tmp_path,
        "nets.device": device,
    }
    config = load_config("default", [f"{key}={value}" for key, value in settings.items()])
    measured = profile(open_source(clip), config, limit=GAP + 1)
    assert measured.n_keyframes == 1
    found = {name: tally.images for name, tally in measured.keyframe.items()}
    assert found["CoarseNet"] == n_grid + n_candidates
    assert found["RefinerNet"] == n_candidates * n_iterations
    assert found["renders"] == n_candidates * (4 * n_iterations + 1)
    assert measured.start["renders"].images == found["renders"] + n_grid, "the grid is rendered once"
    assert "CoarseNet" not in measured.between
    shown = [row["part"] for row in measured.table().rows]
    assert shown[shown.index("hypotheses") + 1 :][:3] == ["  renders", "  CoarseNet", "  RefinerNet"]
    assert np.isnan(measured.device_memory_mib) if device == "cpu" else measured.device_memory_mib > 1


def test_a_clip_without_keyframes_says_so(clip):
    config = load_config("default", ["segmentation.min_area_px=100000"])
    with pytest.raises(UsageError, match="none of 2 frames was a keyframe"):
        profile(open_source(clip), config, limit=2)


def test_the_command_prints_and_writes_figures(clip, tmp_path, capsys):
    out = tmp_path / "profile.json"
    command = ["profile", str(clip), "--config", "default", "--set", "hypotheses.template.n_views=162"]
    assert main([*command, "--set", f"keyframes.gap_frames={GAP}", "--json", str(out), "--quiet"]) == 0
    assert "hypotheses" in capsys.readouterr().out
    figures = json.loads(out.read_text())
    assert {row["part"] for row in figures["parts"]} >= {"segmentation", "hypotheses", "fusion"}
    assert figures["fps"] > 0 and figures["device_memory_mib"] is None
