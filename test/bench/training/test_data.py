import numpy as np
import pytest

from hat_ros.bench.training import data
from hat_ros.bench.training.data import prepare
from hat_ros.bench.training.recipe import Collection, Source

COLLECTION = Collection((Source("model", 1, model="cubesat"), Source("model", 2, model="probe")), 3, 5)


class Stopped(Exception):
    """Ctrl-C, at a place that the test chooses."""


def silent(name, done, total):
    pass


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(data, "_BLOCK", 2)
    flat = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    monkeypatch.setattr(data, "HEIGHT", 2)
    monkeypatch.setattr(data, "WIDTH", 3)
    monkeypatch.setattr(data, "render_background", lambda number, seed: flat + np.uint8(10 * number + seed))


def stop_at(title, count):
    def stop(name, done, total):
        if (name, done) == (title, count):
            raise Stopped

    return stop


def same(one, other):
    np.testing.assert_array_equal(one.views.pixels, other.views.pixels)
    np.testing.assert_array_equal(one.views.index, other.views.index)
    np.testing.assert_array_equal(one.backgrounds, other.backgrounds)


def test_what_was_stopped_goes_on_to_the_same_data(tmp_path, monkeypatch):
    whole = prepare(COLLECTION, tmp_path / "whole", "training", silent)
    assert len(whole.views) == 3
    assert whole.backgrounds[:, 0, 0, 0].tolist() == [5, 15, 25]

    for at in (("views, training", 1), ("backgrounds, training", 2)):
        with pytest.raises(Stopped):
            prepare(COLLECTION, tmp_path / "stopped", "training", stop_at(*at))
    rendered = []
    real = data.render_views
    monkeypatch.setattr(data, "render_views", lambda *told: rendered.append(told) or real(*told))
    same(prepare(COLLECTION, tmp_path / "stopped", "training", silent), whole)
    assert rendered == []
    assert sorted(path.name for path in (tmp_path / "stopped").iterdir()) == ["backgrounds.npy", "views"]


def test_progress_ends_at_the_total(tmp_path):
    told = []
    for _ in range(2):
        prepare(COLLECTION, tmp_path / "data", "kept aside", lambda *one: told.append(one))
        assert ("views, kept aside", 2, 2) in told
        assert told[-1] == ("backgrounds, kept aside", 3, 3)
        told.clear()
