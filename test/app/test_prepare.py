from pathlib import Path

import pytest

from hat_ros.app.prepare import prepare
from hat_ros.bench.synth.models import build_target
from hat_ros.cache import cache_folder
from hat_ros.config import HatConfig
from hat_ros.io import jpeg


def test_what_is_built_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    decoded: list[bytes] = []
    monkeypatch.setattr(jpeg, "check_jpeg", decoded.append)
    parts = prepare(HatConfig(), build_target("cubesat"))
    assert len(decoded) == 3, "what JPEGs need is compiled, too"
    assert [part.name for part in parts] == [
        "segmentation", "hypotheses", "motion", "selector", "fusion", "3 frames"
    ]  # fmt: skip
    assert all(part.seconds >= 0 for part in parts)
    kept = {path.name for path in cache_folder().iterdir()}
    assert any(name.startswith("views-") for name in kept)
    before = {path: path.stat().st_ctime_ns for path in cache_folder().rglob("*.npy")}
    prepare(HatConfig(), build_target("cubesat"))
    assert {path: path.stat().st_ctime_ns for path in cache_folder().rglob("*.npy")} == before
