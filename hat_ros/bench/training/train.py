"""A whole training: data, fit, calibration, figures, export, model card; each step goes on where it was stopped.

DIR/recipe.json         what is trained on, and how
DIR/data/               rendered views and backgrounds
DIR/checkpoint.pt       weights and state of the optimiser
DIR/loss.csv            step, mean loss, seconds since the row before
DIR/segmenter.onnx      the network, for ``segmentation.learned.weights``
DIR/card.json, card.md  the model card, with calibration.png and calibration.svg
"""

from __future__ import annotations

import csv
import hashlib
import json
import platform
import time
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hat_ros.bench.training.card import write_card
from hat_ros.bench.training.data import Data, Progress, prepare
from hat_ros.bench.training.recipe import Recipe
from hat_ros.bench.training.samples import Composer
from hat_ros.errors import MissingDependencyError, RunError, UsageError
from hat_ros.io.own_folder import MARKER, mark
from hat_ros.io.provenance import code_version, package_versions
from hat_ros.io.results import write_json
from hat_ros.segmentation.network import STRIDE, WEIGHTS_NAME

if TYPE_CHECKING:
    from hat_ros.bench.training.fit import Settings
    from hat_ros.bench.training.model import Segmenter

# Sides of samples: of most steps, which are coarser and faster, and of the last ones, as a window has at run time.
_COARSE_PX, _SIDE_PX = 4 * STRIDE, 6 * STRIDE
_NEEDED = ("torch", "onnx")
_PACKAGES = ("hat_ros", "torch", "onnx", "numpy", "opencv-python-headless")


def train(recipe: Recipe, out: Path, progress: Progress) -> dict[str, Any]:
    """Train a segmentation network, or go on with a training that was stopped.

    Args:
        recipe: what to train on, and for how long.
        out: folder, made if need be.
        progress: called with what is counted, how many are done, how many there are.

    Returns:
        The model card, as in ``card.json``.

    Raises:
        MissingDependencyError: torch or onnx is not installed.
        UsageError: ``out`` holds a training by another recipe.
        MeshError: a CAD file cannot be used.
        RunError: the folder cannot be written, or its checkpoint cannot be used.
    """
    _require_packages()  # here, and not after hours of training
    from torch import get_num_threads

    from hat_ros.bench.training.fit import Settings, fit

    settings = Settings(steps=recipe.steps, seed=recipe.seed)
    told = {"training_data": recipe.training.fingerprint(), "kept_data": recipe.kept.fingerprint()}
    told["training"] = _training(recipe, settings)
    _make_folder(out)
    _same_recipe(out / "recipe.json", told)
    data = prepare(recipe.training, out / "data" / "training", "training", progress)
    kept = prepare(recipe.kept, out / "data" / "kept", "kept aside", progress)
    coarse, fine = (Composer(data.views, data.backgrounds, recipe.sample_seed, px) for px in (_COARSE_PX, _SIDE_PX))
    log = _LossLog(out / "loss.csv", settings.steps, progress)
    model = fit(coarse, fine, settings, out / "checkpoint.pt", log.add)
    card = told | _outcome(recipe, kept, model, out, progress)
    card["training"] = told["training"] | log.summary() | {"threads": get_num_threads(), "workers": settings.workers}
    write_card(out, card)
    return card


def _require_packages() -> None:
    for name in _NEEDED:
        try:
            import_module(name)
        except ModuleNotFoundError as error:
            raise MissingDependencyError(
                f"hat train needs the package '{error.name}', which is not installed: run `make install-nets` "
                f"(or `pip install 'hat_ros[train]'`)"
            ) from None


def _training(recipe: Recipe, settings: Settings) -> dict[str, Any]:
    """What determines the fit beside the data; the number of processes does not."""
    told = {name: value for name, value in asdict(settings).items() if name != "workers"}
    return told | {"sample_seed": recipe.sample_seed, "coarse_px": _COARSE_PX, "side_px": _SIDE_PX}


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not (out / MARKER).exists():
            mark(out)
    except OSError as error:
        raise RunError(f"cannot create {out}: {error.strerror}") from None


def _same_recipe(path: Path, told: dict[str, Any]) -> None:
    """Write the recipe of a folder, or check that it is the one that the folder was begun with."""
    if not path.exists():
        partial = path.with_suffix(".partial")
        write_json(partial, told)
        partial.replace(path)
        return
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        before = {}
    if before != told:
        raise UsageError(
            f"--out {path.parent} holds a training by another recipe (other {', '.join(_differing(before, told))}): "
            f"choose another --out, or remove that folder"
        )


def _differing(before: Any, told: dict[str, Any], prefix: str = "") -> list[str]:
    """Keys whose values differ, with the keys above them."""
    names: list[str] = []
    for key, value in told.items():
        other = before.get(key) if isinstance(before, dict) else None
        if isinstance(value, dict):
            names += _differing(other, value, f"{prefix}{key}.")
        elif other != value:
            names.append(f"{prefix}{key}")
    return names


def _outcome(recipe: Recipe, kept: Data, model: Segmenter, out: Path, progress: Progress) -> dict[str, Any]:
    """Calibrate, measure and export; the card's part about that."""
    from hat_ros.bench.training.figures import curve_rows, overlap_rows
    from hat_ros.bench.training.fit import calibrate
    from hat_ros.bench.training.model import export

    progress("figures", 0, 3)
    composer, count = Composer(kept.views, kept.backgrounds, recipe.kept.seed, _SIDE_PX), recipe.kept_samples
    scales, offsets, curve = calibrate(model, composer, count)
    progress("figures", 1, 3)
    rows = overlap_rows(model, composer, count)
    progress("figures", 2, 3)
    path = out / WEIGHTS_NAME
    export(model, path.with_suffix(".partial"), scales, offsets)
    path.with_suffix(".partial").replace(path)
    progress("figures", 3, 3)
    content = path.read_bytes()
    return {
        "network": {
            "file": path.name,
            "bytes": len(content),
            "sha256": hashlib.sha256(content).hexdigest(),
            "parameters": sum(parameter.numel() for parameter in model.parameters()),
        },
        "kept_samples": count,
        "overlap": [asdict(row) for row in rows],
        "calibration": {"scales": scales, "offsets": offsets, "curve": curve_rows(curve)},
        "versions": {
            "code": code_version(),
            "Python": platform.python_version(),
            **package_versions(*_PACKAGES),
        },
    }


class _LossLog:
    """``loss.csv``: a row now and then while the network learns, over all runs of a training."""

    def __init__(self, path: Path, steps: int, progress: Progress) -> None:
        self._path, self._steps, self._progress = path, steps, progress
        self._last = time.monotonic()
        if not path.exists():
            path.write_text("step,loss,seconds\n", encoding="utf-8")

    def add(self, step: int, loss: float, seconds_per_step: float) -> None:
        """A row, and progress."""
        now = time.monotonic()
        with self._path.open("a", encoding="utf-8") as file:
            file.write(f"{step},{loss:.5f},{now - self._last:.1f}\n")
        self._last = now
        self._progress("steps", step, self._steps)

    def summary(self) -> dict[str, Any]:
        """Loss at the end, and seconds of all runs together."""
        with self._path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        seconds = sum(float(row["seconds"]) for row in rows)
        return {"loss": float(rows[-1]["loss"]) if rows else float("nan"), "seconds": seconds}
