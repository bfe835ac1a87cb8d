"""The format is rosbag2's: other programs read it."""

from __future__ import annotations

import yaml
from mcap.reader import make_reader
from recording import N, stamp
from rosbags.rosbag2 import Reader

from hat_ros.io import topics
from hat_ros.io.mcap_folder import McapFolder
from hat_ros.io.rosbag import TYPESTORE, stamp_of_cdr


def test_mcap_and_rosbags_find_the_same_messages(bag):
    with (bag / "bag.mcap").open("rb") as file:
        by_mcap = [(channel.topic, m.log_time, m.data) for _, channel, m in make_reader(file).iter_messages()]
    with Reader(bag) as reader:
        by_rosbags = [(connection.topic, log_ns, bytes(data)) for connection, log_ns, data in reader.messages()]
        assert reader.message_count == len(by_rosbags) == 3 * N + N // 2
    assert sorted(by_mcap) == sorted(by_rosbags)
    assert all(log_ns == stamp_of_cdr(data, bag) for _, log_ns, data in by_rosbags)


def test_metadata_agree_with_the_file(bag):
    described = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    with (bag / "bag.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
        within = {record.name: record.metadata for record in reader.iter_metadata()}
    assert yaml.safe_load(within["rosbag2"]["serialized_metadata"]) == described, "for a file without its folder"
    counts = {
        summary.channels[number].topic: count for number, count in summary.statistics.channel_message_counts.items()
    }
    listed = {item["topic_metadata"]["name"]: item["message_count"] for item in described["topics_with_message_count"]}
    assert listed == counts
    assert described["starting_time"]["nanoseconds_since_epoch"] == summary.statistics.message_start_time == stamp(0)
    assert described["duration"]["nanoseconds"] == stamp(N - 1) - stamp(0)
    hashes = {item["topic_metadata"]["type_description_hash"] for item in described["topics_with_message_count"]}
    assert TYPESTORE.hash_rihs01("sensor_msgs/msg/CameraInfo") in hashes


def test_a_folder_without_messages_is_readable(tmp_path):
    McapFolder(tmp_path / "empty").close()
    with Reader(tmp_path / "empty") as reader:
        assert reader.message_count == 0
        assert list(reader.messages()) == []


def test_chunks_carry_checksums(tmp_path):
    folder = McapFolder(tmp_path / "bag")
    folder.write(topics.END_OF_STREAM, topics.TYPES[topics.END_OF_STREAM], bytes(100), 1)
    folder.close()
    with (tmp_path / "bag" / "bag.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert [len(message.data) for _, _, message in reader.iter_messages()] == [100]
