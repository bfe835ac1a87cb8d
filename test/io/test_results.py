"""Result folders: atomic, readable when stopped, the same from memory and from the bag."""

import numpy as np
import pytest
import yaml
from scripted import CAMERA, steps, true_row, truth

from hat_ros.config import HatConfig, config_from_dict
from hat_ros.errors import BagError, UsageError
from hat_ros.io.own_folder import MARKER
from hat_ros.io.result_bag import ResultBagWriter, read_result_bag
from hat_ros.io.results import LiveTables, ResultFolder, tum_line, write_config
from hat_ros.io.run_log import RunLogBuilder


@pytest.fixture
def bag(tmp_path):
    with ResultBagWriter(tmp_path / "bag", "camera", "target") as writer:
        for step in steps():
            writer.write_step(step, 2)
        writer.write_context(CAMERA, truth(12))
    return tmp_path / "bag"


def in_memory(count=10):
    builder = RunLogBuilder()
    for step in steps(count):
        builder.add(step.candidates, step.motion, step.estimate)
    builder.dropped_total = 2
    return builder.build(truth(count))


def test_bag_gives_back_every_bit_of_the_run(bag):
    read, made = read_result_bag(bag), in_memory()
    for name in vars(made):
        if name == "candidates":
            for a, b in zip(read.candidates, made.candidates, strict=True):
                np.testing.assert_array_equal(a.pose_rows, b.pose_rows)
                np.testing.assert_array_equal(a.log_score, b.log_score)
                np.testing.assert_array_equal(a.box_xyxy, b.box_xyxy)
        else:
            np.testing.assert_array_equal(getattr(read, name), getattr(made, name), err_msg=name)


def test_bag_holds_no_image_and_truth_only_of_the_run(bag):
    from rosbags.rosbag2 import Reader

    with Reader(bag) as reader:
        assert not any("Image" in connection.msgtype for connection in reader.connections)
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
    assert counts["/ground_truth/target_pose"] == 10
    assert counts["/hat/status"] == counts["/hat/selection"] == counts["/hat/slam_state"] == 10
    assert counts["/target_pose"] == 7, "nothing is published while UNINITIALISED or LOST"
    assert counts["/hat/alignment"] == 1, "only on change"


def test_bag_that_was_altered_is_refused(bag):
    data = bytearray((bag / "bag.mcap").read_bytes())
    data[len(data) // 2] ^= 1
    (bag / "bag.mcap").write_bytes(bytes(data))
    with pytest.raises(BagError, match="SHA-256"):
        read_result_bag(bag)


def test_folder_that_is_no_bag_is_refused(tmp_path):
    with pytest.raises(BagError, match=r"metadata\.yaml"):
        read_result_bag(tmp_path)


def test_finished_folder_appears_under_its_name(tmp_path):
    with ResultFolder(tmp_path / "out") as folder:
        write_config(folder.path, HatConfig())
        assert folder.path.name == "out.partial"
        assert not (tmp_path / "out").exists()
    assert (tmp_path / "out" / "config.yaml").is_file()
    assert not (tmp_path / "out.partial").exists()


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_stopped_run_keeps_what_was_done_under_partial(tmp_path, error):
    with pytest.raises(error), ResultFolder(tmp_path / "out") as folder:
        write_config(folder.path, HatConfig())
        tables = LiveTables(folder.path, ("latency_ms",))
        for step in steps(5):
            tables.add(step.estimate, (1.0,))
        raise error
    left = tmp_path / "out.partial"
    assert not (tmp_path / "out").exists()
    assert len((left / "poses.tum").read_text().splitlines()) == 4, "lines are flushed one by one"
    assert len((left / "frames.csv").read_text().splitlines()) == 1 + 5


def test_next_run_replaces_the_partial_of_a_stopped_one(tmp_path):
    with pytest.raises(KeyboardInterrupt), ResultFolder(tmp_path / "out") as folder:
        write_config(folder.path, HatConfig())
        raise KeyboardInterrupt
    with ResultFolder(tmp_path / "out") as folder:
        assert [path.name for path in folder.path.iterdir()] == [MARKER]
        write_config(folder.path, HatConfig())
    assert (tmp_path / "out").is_dir()


def test_finished_result_is_not_overwritten_unasked(tmp_path):
    for overwrite in (False, True):
        if overwrite:
            with pytest.raises(UsageError, match="--overwrite"):
                ResultFolder(tmp_path / "out")
        with ResultFolder(tmp_path / "out", overwrite) as folder:
            write_config(folder.path, HatConfig())


@pytest.mark.parametrize("name", ["photos", "photos.partial"])
@pytest.mark.parametrize("holds", ["cat.jpg", "config.yaml", "run.json", "metadata.yaml", MARKER])
def test_overwrite_never_deletes_what_we_have_not_made(tmp_path, name, holds):
    (tmp_path / name).mkdir()
    (tmp_path / name / holds).write_text("x")
    with pytest.raises(UsageError, match="not a folder that hat has made"):
        ResultFolder(tmp_path / "photos", overwrite=True)
    assert (tmp_path / name / holds).read_text() == "x"


def test_what_is_no_place_for_a_result_is_refused(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    (tmp_path / "here" / "deep").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    for path in ("", ".", "..", "/", "deep/..", str(tmp_path), str(tmp_path / "file"), str(tmp_path / "file" / "out")):
        with pytest.raises(UsageError, match="--out"):
            ResultFolder(path, overwrite=True)
    assert (tmp_path / "file").read_text() == "x" and (tmp_path / "here" / "deep").is_dir()


def test_a_second_run_into_the_same_folder_is_refused_until_the_first_has_ended(tmp_path):
    with ResultFolder(tmp_path / "out") as first:
        write_config(first.path, HatConfig())
        with pytest.raises(UsageError, match="another command is writing"), ResultFolder(tmp_path / "out"):
            raise AssertionError
        assert (first.path / "config.yaml").is_file()
        late = ResultFolder(tmp_path / "out")
    with pytest.raises(UsageError, match="--overwrite"), late:
        raise AssertionError
    assert (tmp_path / "out" / "config.yaml").is_file()


def test_old_result_stays_until_the_new_one_is_complete(tmp_path):
    with ResultFolder(tmp_path / "out") as folder:
        write_config(folder.path, HatConfig())
        (folder.path / "old").touch()
    with pytest.raises(KeyboardInterrupt), ResultFolder(tmp_path / "out", overwrite=True):
        raise KeyboardInterrupt
    assert (tmp_path / "out" / "old").exists()


def test_config_as_used_is_complete_and_reads_back(tmp_path):
    write_config(tmp_path, HatConfig())
    assert config_from_dict(yaml.safe_load((tmp_path / "config.yaml").read_text())) == HatConfig()


def test_tum_line_keeps_nanoseconds_and_every_bit():
    row = true_row(3) / 3.0
    text = tum_line(1_700_000_000_123_456_789, row).split()
    assert text[0] == "1700000000.123456789"
    np.testing.assert_array_equal(np.array(text[1:], dtype=float), row)
