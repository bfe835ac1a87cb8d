"""Encoding templates keeps what was done: a run that is stopped goes on where it was."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hat_ros.cache import cache_folder
from hat_ros.config import NetsConfig
from hat_ros.hypotheses import picopose
from hat_ros.nets import picopose as pp
from hat_ros.nets.runtime import Runtime

N = 19


def test_a_stopped_encoding_goes_on_where_it_was(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    rng = np.random.default_rng(1)
    templates = SimpleNamespace(
        crops=rng.integers(0, 256, (N, 3, 224, 224), dtype=np.uint8),
        masks=np.ones((N, 224, 224), np.float32),
        M=np.zeros((N, 3, 3)),
        T_cam_target=np.zeros((N, 4, 4)),
        points_m=np.zeros((N, 2, 2, 3)),
    )
    monkeypatch.setattr(picopose, "render_templates", lambda target: templates)
    encoded = []

    def encode(crops, stop_after=None):
        if stop_after is not None and len(encoded) >= stop_after:
            raise KeyboardInterrupt
        encoded.append(len(crops))
        return [crops.mean(dim=(1, 2, 3))[:, None] * (i + 1) for i in range(len(pp.FEATURE_BLOCKS))]

    def load(extract):
        backend = object.__new__(picopose.PicoPoseHypotheses)
        backend._runtime, backend._settings = Runtime(NetsConfig(), "picopose"), SimpleNamespace(batch_size=4)
        backend._extract = extract
        backend._load_templates(SimpleNamespace(sha256="a"), "b")
        return backend

    with pytest.raises(KeyboardInterrupt):
        load(lambda crops: encode(crops, stop_after=3))
    done = list(encoded)
    resumed = load(encode)
    assert sum(encoded) == N and encoded[:3] == done, "no template is encoded twice"
    assert [path.name.split("-")[0] for path in cache_folder().iterdir()] == ["picopose"], "the parts are gone"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    assert torch.equal(resumed._matching, load(encode)._matching)
