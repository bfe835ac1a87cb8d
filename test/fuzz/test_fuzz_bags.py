"""Bags: changed bytes of the file, and good files with changed messages, which no checksum tells."""

from __future__ import annotations

import shutil

import pytest
import trimesh
from mutator import mutated, spliced
from recording import write
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from hat_ros.bench.source import open_source
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.manifest import MANIFEST
from hat_ros.io.rosbag import TYPESTORE


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Bytes of two MCAP files, and the (topic, kind, time, bytes) of the messages of the first."""
    folder = tmp_path_factory.mktemp("bags")
    write(folder / "one", n=3)
    write(folder / "two", n=2, image_format="jpeg")
    with Reader(folder / "one") as reader:
        sent = [(to.topic, to.msgtype, time, bytes(data)) for to, time, data in reader.messages()]
    return [(folder / name / f"{name}.mcap").read_bytes() for name in ("one", "two")], sent


def everything(bag):
    return bag.camera, bag.frame_id, bag.truth(), [frame.given_mask for frame in bag.frames()]


def test_files(fuzz, recorded, tmp_path):
    files, _ = recorded

    def make(rng):
        if rng.random() < 0.2:
            return spliced(*rng.sample(files, 2), rng)
        return mutated(rng.choice(files), rng)

    def read(data):
        path = tmp_path / "bag.mcap"
        path.write_bytes(data)
        return everything(BagReader(path))

    fuzz("mcap", make, read)


def test_metadata(fuzz, tmp_path):
    folder = write(tmp_path / "bag", n=2)
    (folder / MANIFEST).unlink()  # it would refuse every change
    text = (folder / "metadata.yaml").read_bytes()
    trimesh.creation.box((0.3, 0.4, 0.5)).export(folder / "model.ply")
    (folder / "target.yaml").write_text("mesh: model.ply\n")

    def read(data):
        (folder / "metadata.yaml").write_bytes(data)
        source = open_source(folder)
        return source.frame_id, source.truth_rows(), list(source.frames())

    fuzz("metadata", lambda rng: mutated(text, rng, is_text=True), read)


@pytest.mark.parametrize("plugin", list(StoragePlugin), ids=lambda plugin: plugin.name.lower())
def test_messages(plugin, fuzz, recorded, tmp_path):
    _, sent = recorded

    def make(rng):
        chosen = rng.randrange(len(sent))
        return bytes([chosen]) + sent[chosen][3][:4] + mutated(sent[chosen][3][4:], rng)

    def read(data):
        shutil.rmtree(tmp_path / "bag", ignore_errors=True)
        with Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
            kinds = {topic: kind for topic, kind, _, _ in sent}
            to = {topic: writer.add_connection(topic, kind, typestore=TYPESTORE) for topic, kind in kinds.items()}
            for index, (topic, _, time, good) in enumerate(sent):
                writer.write(to[topic], time, data[1:] if index == data[0] else good)
        return everything(BagReader(tmp_path / "bag"))

    fuzz(f"bag_{plugin.name.lower()}", make, read)
