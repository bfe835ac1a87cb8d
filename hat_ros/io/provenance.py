"""Where a result comes from: code, inputs, versions. What makes a figure traceable (``run.json``)."""

from __future__ import annotations

import hashlib
import json
import platform
import subprocess
import sys
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import hat_ros
from hat_ros.config import HatConfig, config_to_dict

_PACKAGES = ("hat_ros", "numpy", "scipy", "opencv-python-headless", "embreex", "numba", "rosbags", "torch")
_BLOCK_BYTES = 1 << 20
_PACKAGE = Path(hat_ros.__file__).resolve().parent


def code_version() -> str:
    """Commit of the checkout, with ``+changes`` when files differ from it; the package version when installed."""
    root = _PACKAGE.parent
    if not (root / ".git").exists():  # installed, perhaps within another project's checkout
        return _version("hat_ros") or "unknown"
    try:
        commit = _git(root, "rev-parse", "HEAD")
        changed = _git(root, "status", "--porcelain", "--untracked-files=no", "--", "hat_ros", "config")
    except (OSError, subprocess.SubprocessError):
        return _version("hat_ros") or "unknown"
    return commit + ("+changes" if changed else "")


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=20).stdout.strip()


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def package_versions(*names: str) -> dict[str, str]:
    """Name -> version of those packages that are installed."""
    return {name: version for name in names if (version := _version(name))}


def config_hash(config: HatConfig) -> str:
    """SHA-256 of the configuration's values, independent of how they were given."""
    return hashlib.sha256(json.dumps(config_to_dict(config), sort_keys=True).encode()).hexdigest()


def input_hash(path: Path) -> str:
    """SHA-256 over the names and contents of a file or of all files of a folder."""
    digest = hashlib.sha256()
    files = [path] if path.is_file() else sorted(item for item in path.rglob("*") if item.is_file())
    for item in files:
        digest.update(f"{item.relative_to(path) if item != path else item.name}\0{item.stat().st_size}\0".encode())
        with item.open("rb") as file:
            while block := file.read(_BLOCK_BYTES):
                digest.update(block)
    return digest.hexdigest()


def describe_run(source: Path, source_sha256: str, config: HatConfig, **more: Any) -> dict[str, Any]:
    """Contents of ``run.json``: source and its hash, configuration hash, code, versions, machine."""
    return {
        "source": str(source.resolve()),
        "source_sha256": source_sha256,
        "config_sha256": config_hash(config),
        "code": code_version(),
        "code_sha256": code_hash(),
        "python": platform.python_version(),
        "packages": package_versions(*_PACKAGES),
        "machine": f"{platform.system()} {platform.machine()}",
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        **more,
    }


@cache
def code_hash() -> str:
    """SHA-256 over the package's Python sources and network weights: what the code really was, committed or not."""
    digest = hashlib.sha256()
    for item in sorted([*_PACKAGE.rglob("*.py"), *_PACKAGE.rglob("*.onnx")]):
        digest.update(f"{item.relative_to(_PACKAGE)}\0".encode() + item.read_bytes())
    return digest.hexdigest()
