import os

import numpy as np
import pytest

from hat_ros import cache
from hat_ros.cache import cache_folder, cached_arrays


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def build():
    return {"a": np.arange(6).reshape(2, 3), "empty": np.zeros((0, 4))}


def forbidden():
    pytest.fail("built again")


def test_second_call_reads_what_the_first_built():
    first = cached_arrays("thing", "key", build)
    second = cached_arrays("thing", "key", forbidden)
    for name, array in build().items():
        np.testing.assert_array_equal(first[name], array)
        np.testing.assert_array_equal(second[name], array)
        assert not second[name].flags.writeable


def test_another_key_is_another_entry():
    cached_arrays("thing", "key", build)
    other = cached_arrays("thing", "other", lambda: {"a": np.zeros(2)})
    np.testing.assert_array_equal(other["a"], np.zeros(2))


@pytest.mark.parametrize("damage", ["flip", "truncate", "manifest", "missing"])
def test_a_damaged_entry_is_built_again(damage):
    cached_arrays("thing", "key", build)
    entry = next(cache_folder().glob("thing-*"))
    array, manifest = entry / "a.npy", entry / "manifest.json"
    content = bytearray(array.read_bytes())
    if damage == "flip":
        content[-1] ^= 1
        array.write_bytes(content)
    elif damage == "truncate":
        array.write_bytes(content[:-5])
    elif damage == "manifest":
        manifest.write_text("not json")
    else:
        array.unlink()
    calls = []
    arrays = cached_arrays("thing", "key", lambda: calls.append(1) or build())
    assert calls == [1]
    np.testing.assert_array_equal(arrays["a"], build()["a"])
    np.testing.assert_array_equal(cached_arrays("thing", "key", forbidden)["a"], build()["a"])


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    np.testing.assert_array_equal(cached_arrays("thing", "key", build)["a"], build()["a"])


def test_no_unfinished_entries_stay_behind():
    cached_arrays("thing", "key", build)
    assert [path.name.split("-")[0] for path in cache_folder().iterdir()] == ["thing"]


def test_what_was_not_used_for_longest_makes_room(monkeypatch):
    monkeypatch.setattr(cache, "MAX_BYTES", 3 * 4096)
    page = {"a": np.arange(3872, dtype=np.uint8)}  # a page with header and manifest
    old, *_ = [cached_arrays("thing", key, lambda: page)["a"] for key in ("old", "used", "new")]
    for entry in cache_folder().iterdir():
        os.utime(entry, (0, 0))
    for key in ("used", "new"):
        cached_arrays("thing", key, forbidden)
    cached_arrays("thing", "newest", lambda: page)
    for key in ("used", "new", "newest"):
        cached_arrays("thing", key, forbidden)
    assert len(list(cache_folder().iterdir())) == 3
    np.testing.assert_array_equal(old, page["a"])  # who has it keeps it


def test_an_entry_larger_than_the_cache_is_still_read(monkeypatch):
    monkeypatch.setattr(cache, "MAX_BYTES", 10)
    np.testing.assert_array_equal(cached_arrays("thing", "key", build)["a"], build()["a"])
    cached_arrays("thing", "key", forbidden)


def test_damaged_headers_are_rebuilt_whatever_they_make_the_parser_raise(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    wanted = np.arange(12.0)

    def get():
        return cached_arrays("kind", "key", lambda: {"a": wanted})["a"]

    get()
    (file,) = tmp_path.glob("hat_ros/kind-*/a.npy")
    whole, rng = file.read_bytes(), np.random.default_rng(5)
    headers = [
        b"{'descr': lambda: 0",
        b"{" * 100,
        b"{'descr': '<f8', 'fortran_order': 0, 'shape': (10**30,)}",
        b"((((",
        b"1e",
    ]
    damaged = [whole[:10] + header.ljust(118) + whole[128:] for header in headers]
    for _ in range(60):
        data = bytearray(whole)
        for at in rng.integers(0, 128, 4):
            data[at] = rng.integers(256)
        damaged.append(bytes(data))
    for data in damaged:
        file.unlink()
        file.write_bytes(data)
        np.testing.assert_array_equal(get(), wanted)
        assert file.read_bytes() == whole or file.read_bytes()[128:] == whole[128:]
