"""``hat doctor``: one check per thing that a run may need, each with what was found and what to do."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec

import numpy as np

from hat_ros.errors import HatError

# Module -> package on PyPI. Looked for by module: apt's OpenCV has no package metadata.
_REQUIRED = {
    "numpy": "numpy",
    "scipy": "scipy",
    "cv2": "opencv-python-headless",
    "trimesh": "trimesh",
    "numba": "numba",
    "rosbags": "rosbags",
    "mcap": "mcap",
    "lz4": "lz4",
    "zstandard": "zstandard",
    "yaml": "PyYAML",
    "rich": "rich",
    "matplotlib": "matplotlib",
    "PIL": "pillow",
}
_OPTIONAL = {"torch": "nets", "transformers": "nets", "safetensors": "nets", "onnx": "train", "pyrender": "gl"}
# Packages whose releases have broken this one before -> oldest and newest version that the tests run with.
TESTED = {
    "numba": ("0.59.0", "0.68.1"),
    "embreex": ("2.17.7.post5", "4.4.0.post1"),
    "opencv-python-headless": ("4.6.0.66", "4.13.0.92"),
}


@dataclass(frozen=True)
class Finding:
    """One line of the table.

    Attributes:
        what: what was looked for.
        verdict: ``ok``; ``missing``: the default preset cannot run; ``optional``: only some backends need it;
            ``untested``: a version outside the tested range, which may well work.
        found: what was found, or what to do.
    """

    what: str
    verdict: str
    found: str


def run_checks() -> list[Finding]:
    """All checks, in the order in which a new user would meet the problems."""
    checks: tuple[Callable[[], list[Finding]], ...] = (
        _python,
        _packages,
        _versions,
        _presets,
        _renderer,
        _cache,
        _ros,
        _optional_packages,
        _weights,
    )
    return [finding for check in checks for finding in check()]


def _python() -> list[Finding]:
    version = ".".join(map(str, sys.version_info[:3]))
    good = (3, 11) <= sys.version_info[:2] <= (3, 13)
    return [Finding("Python", "ok" if good else "missing", version if good else f"{version}: 3.11 to 3.13 is needed")]


def _packages() -> list[Finding]:
    missing = [package for module, package in _REQUIRED.items() if find_spec(module) is None]
    if missing:
        names = " ".join(missing)
        return [Finding("packages", "missing", f"not installed; run `make install` or `pip install {names}`")]
    found = (f"{package} {installed_version(package) or '(version not stated)'}" for package in _REQUIRED.values())
    return [Finding("packages", "ok", ", ".join(found))]


def _versions() -> list[Finding]:
    return [
        finding
        for package, (oldest, newest) in TESTED.items()
        if (finding := compare_version(package, installed_version(package), oldest, newest)) is not None
    ]


def compare_version(package: str, version: str | None, oldest: str, newest: str) -> Finding | None:
    """A finding when the version is outside the tested range; packages that are not installed are another check's.

    Only the first three numbers count: what follows them names builds.
    """
    if version is None or _numbers(oldest) <= _numbers(version) <= _numbers(newest):
        return None
    advice = f"if results look wrong, pip install '{package}>={oldest},<={newest}'"
    return Finding(package, "untested", f"{version}; tested with {oldest} to {newest}: {advice}")


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])


def installed_version(package: str) -> str | None:
    """Version of an installed package; OpenCV from apt or from source has it in its module alone."""
    version = _version(package)
    if version is None and package == "opencv-python-headless" and find_spec("cv2") is not None:
        import cv2

        return cv2.__version__
    return version


def _optional_packages() -> list[Finding]:
    out = []
    for name, extra in _OPTIONAL.items():
        version = _version(name)
        found = version or f"not installed; learned backends and extras: pip install 'hat_ros[{extra}]'"
        out.append(Finding(name, "ok" if version else "optional", found))
    return out


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _presets() -> list[Finding]:
    from hat_ros.config import load_config, preset_folder, preset_names

    try:
        names = preset_names()
        for name in names:
            load_config(name)
    except HatError as error:
        return [Finding("presets", "missing", str(error))]
    return [Finding("presets", "ok", f"{', '.join(names)} in {preset_folder()}")]


def _renderer() -> list[Finding]:
    import trimesh

    from hat_ros.geometry import lie
    from hat_ros.target.loading import target_from_scene
    from hat_ros.target.ray_renderer import RayRenderer
    from hat_ros.types import Camera

    target = target_from_scene(trimesh.Scene(trimesh.creation.box((1.0, 1.0, 1.0))), "cube")
    camera = Camera(np.array([[100.0, 0, 31.5], [0, 100.0, 31.5], [0, 0, 1]]), 64, 64)
    start = time.perf_counter()
    mask = RayRenderer(target).render(lie.transform(np.eye(3), np.array([0.0, 0.0, 4.0])), camera, color=False).mask
    elapsed_ms = 1e3 * (time.perf_counter() - start)
    caster = f"Embree {_version('embreex')}" if find_spec("embreex") else "compiled rays (embreex is not installed)"
    # A unit cube whose near face is 3.5 m away covers 100 / 3.5 pixels a side.
    side = np.sqrt(np.count_nonzero(mask))
    if abs(side - 100 / 3.5) > 1.0:
        found = f"{caster} drew a cube {side:.1f} px wide instead of {100 / 3.5:.1f} px"
        return [Finding("renderer", "missing", found)]
    return [Finding("renderer", "ok", f"{caster}, test view in {elapsed_ms:.1f} ms")]


def _cache() -> list[Finding]:
    from hat_ros.cache import cache_folder

    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        return [Finding("cache", "missing", f"{folder} is not writable ({error.strerror})")]
    return [Finding("cache", "ok", str(folder))]


def _ros() -> list[Finding]:
    """In a process of its own: a broken middleware must not take this one down."""
    environment = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"} | os.environ
    probe = [sys.executable, "-c", "import rclpy; print(rclpy.get_rmw_implementation_identifier())"]
    try:
        found = subprocess.run(probe, capture_output=True, text=True, timeout=60, env=environment)
    except subprocess.TimeoutExpired:
        return [Finding("rclpy", "missing", "importing it takes more than a minute")]
    if found.returncode != 0:
        advice = "source your ROS 2, run `make install` or `pip install 'hat_ros[ros]'` (hat track works without)"
        return [Finding("rclpy", "missing", f"not importable; {advice}")]
    out = [Finding("rclpy", "ok", found.stdout.strip())]
    try:
        dds = subprocess.run(
            [sys.executable, "-m", "hat_ros.ros.probe"], capture_output=True, timeout=60, env=environment
        )
        good = dds.returncode == 0
    except subprocess.TimeoutExpired:
        good = False
    advice = "no message arrived on this machine: check firewall rules for loopback UDP and that /dev/shm is writable"
    out.append(
        Finding("DDS loopback", "ok" if good else "missing", "a message made the round trip" if good else advice)
    )
    return out


def _weights() -> list[Finding]:
    from hat_ros.nets.checkpoint import find, weights_folder
    from hat_ros.nets.checkpoint_registry import CHECKPOINTS

    present = []
    for name in CHECKPOINTS:
        try:
            find(name)
            present.append(name)
        except HatError:
            continue
    names = f"{', '.join(present)} (not read here: run `hat weights check`)"
    found = f"{weights_folder()}: {names if present else 'none; only the learned backends need them'}"
    return [Finding("weights", "ok" if len(present) == len(CHECKPOINTS) else "optional", found)]
