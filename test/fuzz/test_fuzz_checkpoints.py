"""Files of weights: safetensors and pickles, zipped and not, opened directly and converted."""

from __future__ import annotations

import io
import struct

import pytest
from mutator import mutated

from hat_ros.nets import checkpoint

torch = pytest.importorskip("torch")
safetensors = pytest.importorskip("safetensors.torch")

NAME = "fuzzed"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Weights folder; its checkpoint has no published checksum, so that every file is read."""
    entry = checkpoint.Checkpoint(NAME, "fuzzed.pth", "https://example.org", "MIT")
    monkeypatch.setitem(checkpoint.CHECKPOINTS, NAME, entry)
    return tmp_path


def state():
    return {"layer.weight": torch.arange(12.0).reshape(3, 4), "layer.bias": torch.ones(3), "steps": torch.tensor(7)}


def pickled(**options):
    stream = io.BytesIO()
    torch.save(state(), stream, **options)
    return stream.getvalue()


def test_safetensors(fuzz, folder):
    whole = safetensors.save(state())
    size = struct.unpack("<Q", whole[:8])[0]

    def make(rng):
        if rng.random() < 0.5:
            return mutated(whole, rng)
        header = mutated(whole[8 : 8 + size], rng, is_text=True)
        return struct.pack("<Q", len(header)) + header + whole[8 + size :]

    def read(data):
        (folder / f"{NAME}.safetensors").write_bytes(data)
        return checkpoint.load_state(NAME, folder)

    fuzz("safetensors", make, read)


def test_pickles(fuzz, folder):
    files = [pickled(), pickled(_use_new_zipfile_serialization=False)]

    def make(rng):
        return rng.choice((b"l", b"c")) + mutated(rng.choice(files), rng)

    def read(data):
        (folder / "fuzzed.pth").write_bytes(data[1:])
        (folder / f"{NAME}.safetensors").unlink(missing_ok=True)
        return (checkpoint.load_state if data[:1] == b"l" else checkpoint.convert)(NAME, folder=folder)

    fuzz("pickle", make, read)
