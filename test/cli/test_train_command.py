"""`hat train segmenter`: options to recipe, errors, what it prints."""

import sys
from pathlib import Path

import pytest

from hat_ros.bench.training import train as module
from hat_ros.bench.training.recipe import Recipe
from hat_ros.cli import main

ROW = {"samples": 4, "evidence": 0.5, "primed": 2, "evidence_primed": 0.4, "tracked": 0.6}


@pytest.fixture
def called(monkeypatch):
    """What the command hands on, instead of hours of training."""
    calls = []

    def train(recipe, out, progress):
        progress("steps", 1, 1)
        calls.append((recipe, out))
        return {"overlap": [{"low_px": 0.0, "high_px": float("inf")} | ROW]}

    monkeypatch.setattr(module, "train", train)
    return calls


def test_the_defaults_are_those_of_the_recipe(called, tmp_path, capsys):
    assert main(["train", "segmenter", "--out", str(tmp_path / "out")]) == 0
    assert called == [(Recipe(), tmp_path / "out")]
    assert "0.600" in capsys.readouterr().out


def test_options_reach_the_recipe(called, tmp_path, capsys):
    words = "--cad a.glb b.glb --kept-cad c.glb --generated 5 --views 4 --backgrounds 3 --steps 2 --seed 1 --quiet"
    assert main(["train", "segmenter", *words.split(), "--out", str(tmp_path / "out")]) == 0
    assert called[0][0] == Recipe((Path("a.glb"), Path("b.glb")), (Path("c.glb"),), 5, 4, 3, 2, 1)
    shown = capsys.readouterr()
    assert shown.out == shown.err == ""


def test_a_missing_cad_is_one_sentence(tmp_path, capsys):
    pytest.importorskip("torch", reason="the extra 'train' is not installed")
    pytest.importorskip("onnx", reason="the extra 'train' is not installed")
    assert main(["train", "segmenter", "--cad", "nothing.glb", "--out", str(tmp_path / "out"), "--quiet"]) == 2
    assert capsys.readouterr().err == "hat: CAD model nothing.glb: no such file\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("missing", ["torch", "onnx"])
def test_a_missing_package_is_named_before_anything_is_rendered(missing, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(module, "_NEEDED", (missing,))
    monkeypatch.setitem(sys.modules, missing, None)
    assert main(["train", "segmenter", "--out", str(tmp_path / "out"), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"hat: hat train needs the package '{missing}'")
    assert "pip install 'hat_ros[train]'" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()
