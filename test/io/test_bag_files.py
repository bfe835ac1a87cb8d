"""Bags as recorders leave them: edited, without metadata, split, compressed, with foreign channels."""

from __future__ import annotations

import gc
import json
import tempfile

import numpy as np
import pytest
import yaml
import zstandard
from mcap.writer import Writer
from recording import CAMERA, WIRE, N, image, stamp
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagOfOthers

from hat_ros.errors import BagError
from hat_ros.io.bag_files import bag_files
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.manifest import MANIFEST
from hat_ros.io.rosbag import TYPESTORE


def stamps_of(path):
    reader = BagReader(path)
    frames = list(reader.frames())
    assert len(reader) == len(frames)
    for frame in frames:
        assert np.array_equal(frame.rgb, image(frame.stamp_ns // 100_000_000 - 10))
    return [frame.stamp_ns for frame in frames]


ALL = [stamp(index) for index in range(N)]


def metadata_changed(bag, change):
    (bag / MANIFEST).unlink()
    content = yaml.safe_load((bag / "metadata.yaml").read_text())
    change(content["rosbag2_bagfile_information"])
    (bag / "metadata.yaml").write_text(yaml.safe_dump(content))
    return bag


def other_qos(information):
    for topic in information["topics_with_message_count"]:
        topic["topic_metadata"]["offered_qos_profiles"] = [{"depth": 7, "reliability": "reliable"}]


@pytest.mark.parametrize(
    "change",
    [
        other_qos,
        lambda information: information.update(storage_identifier=""),
        lambda information: information.update(version=99),
        lambda information: information.pop("topics_with_message_count"),
    ],
)
def test_what_is_edited_in_the_metadata_does_not_matter(bag, change):
    assert stamps_of(metadata_changed(bag, change)) == ALL


def write_part(path, indices, channels=()):
    """An MCAP file as any recorder may write it."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="other")
        for topic in channels:
            schema = writer.register_schema("Note", "jsonschema", b'{"type": "object"}')
            note = writer.register_channel(topic, "json", schema)
            writer.add_message(note, stamp(0), json.dumps({"a": 1}).encode(), publish_time=0)
        numbers = {}
        for index in indices:
            for topic, message in (
                ("/camera_info", WIRE.camera_info(stamp(index), "c", CAMERA)),
                ("/image", WIRE.image(stamp(index), "c", "rgb8", image(index))),
            ):
                kind = message.__msgtype__
                if topic not in numbers:
                    definition, _ = TYPESTORE.generate_msgdef(kind, ros_version=2)
                    schema = writer.register_schema(kind, "ros2msg", definition.encode())
                    numbers[topic] = writer.register_channel(topic, "cdr", schema)
                data = bytes(TYPESTORE.serialize_cdr(message, kind))
                writer.add_message(numbers[topic], stamp(index), data, publish_time=stamp(index))
        writer.finish()


def test_a_folder_without_metadata_is_read(bag):
    (bag / MANIFEST).unlink()
    (bag / "metadata.yaml").unlink()
    assert stamps_of(bag) == ALL


def test_split_files_are_one_recording_in_order(tmp_path):
    for part, indices in ((2, range(2)), (9, range(2, 4)), (10, range(4, N))):
        write_part(tmp_path / f"clip_{part}.mcap", indices)
    assert [file.name for file in bag_files(tmp_path)] == ["clip_2.mcap", "clip_9.mcap", "clip_10.mcap"]
    assert stamps_of(tmp_path) == ALL
    names = ["clip_10.mcap", "clip_2.mcap", "clip_9.mcap"]
    listed = {"rosbag2_bagfile_information": {"relative_file_paths": names}}
    (tmp_path / "metadata.yaml").write_text(yaml.safe_dump(listed))
    assert stamps_of(tmp_path) == ALL, "the order of the list does not matter"
    (tmp_path / "clip_9.mcap").unlink()
    with pytest.raises(BagError, match=r"lacks clip_9\.mcap"):
        BagReader(tmp_path)


def test_channels_that_are_no_ros_messages_are_left_alone(tmp_path):
    write_part(tmp_path / "a.mcap", range(N), channels=("/notes", "/camera/info_json"))
    assert stamps_of(tmp_path / "a.mcap") == ALL
    assert sorted(BagReader(tmp_path).topics) == ["/camera_info", "/image"]


def packed(data):
    return zstandard.ZstdCompressor().compress(data)


@pytest.mark.parametrize("with_metadata", [True, False])
@pytest.mark.parametrize("suffix", ["mcap", "db3"])
def test_files_compressed_as_a_whole_are_read(tmp_path, monkeypatch, suffix, with_metadata):
    bag = of_others(tmp_path / "bag", StoragePlugin.MCAP if suffix == "mcap" else StoragePlugin.SQLITE3)
    file = next(bag.glob(f"*.{suffix}"))
    file.with_name(f"{file.name}.zstd").write_bytes(packed(file.read_bytes()))
    file.unlink()
    if not with_metadata:
        (bag / "metadata.yaml").unlink()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert stamps_of(bag) == ALL
    gc.collect()
    assert list(tmp_path.iterdir()) == [bag], "what was unpacked is gone"


def of_others(path, plugin, change=bytes):
    with BagOfOthers(path, version=9, storage_plugin=plugin) as writer:
        topics = {
            "/camera_info": lambda index: WIRE.camera_info(stamp(index), "c", CAMERA),
            "/image": lambda index: WIRE.image(stamp(index), "c", "rgb8", image(index)),
        }
        for topic, make in topics.items():
            connection = writer.add_connection(topic, make(0).__msgtype__, typestore=TYPESTORE)
            for index in range(N):
                data = bytes(TYPESTORE.serialize_cdr(make(index), connection.msgtype))
                writer.write(connection, stamp(index), change(data))
    return path


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_messages_compressed_one_by_one_are_read(tmp_path, plugin):
    assert stamps_of(of_others(tmp_path / "bag", plugin, packed)) == ALL


def test_a_message_that_unpacks_without_end_is_refused(tmp_path):
    bomb = packed(bytes(600 * 2**20))
    path = of_others(tmp_path / "bag", StoragePlugin.SQLITE3, lambda _: bomb)
    with pytest.raises(BagError, match="a message on /camera_info unpacks to more than"):
        list(BagReader(path).frames())


def test_damaged_metadata_is_named(bag):
    (bag / MANIFEST).unlink()
    (bag / "metadata.yaml").write_text("{[")
    with pytest.raises(BagError, match=r"metadata\.yaml is damaged: delete it"):
        BagReader(bag)


def test_a_truncated_file_is_told_how_to_recover(bag):
    (bag / MANIFEST).unlink()
    file = bag / "bag.mcap"
    file.write_bytes(file.read_bytes()[:-400])
    with pytest.raises(BagError, match=r"mcap recover .*bag\.mcap -o bag_whole\.mcap"):
        BagReader(bag)


def test_flipped_bits_never_alter_what_is_read(tmp_path):
    """Without a manifest, by the checksums of the file alone."""
    write_part(tmp_path / "a.mcap", range(2))
    data = (tmp_path / "a.mcap").read_bytes()
    rng, refused = np.random.default_rng(2), 0
    for at in rng.integers(0, len(data), 60):
        bad = bytearray(data)
        bad[at] ^= 1 << rng.integers(8)
        (tmp_path / "a.mcap").write_bytes(bad)
        try:
            assert stamps_of(tmp_path) == ALL[:2]
        except BagError as error:
            refused += "\n" not in str(error)
    assert refused > 40


def test_metadata_whose_numbers_are_none_is_damaged(bag):
    (bag / MANIFEST).unlink()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: !!int '', relative_file_paths: []}")
    with pytest.raises(BagError, match="is damaged: delete it"):
        BagReader(bag)


def test_metadata_that_lists_a_name_no_file_can_have(bag):
    metadata_changed(bag, lambda information: information.update(relative_file_paths=["x" * 300]))
    with pytest.raises(BagError, match="lacks x"):
        BagReader(bag)
