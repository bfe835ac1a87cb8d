"""YAML of others: whatever it holds, a value or one sentence, soon and in little memory."""

import os
import random
import time

import pytest
import yaml

from hat_ros.bench.datasets.calibration_file import read_camera_file
from hat_ros.config import load_config, preset_folder
from hat_ros.config.yaml_text import MAX_BYTES, parse_yaml, read_yaml
from hat_ros.errors import ConfigError, DatasetError, MeshError
from hat_ros.target.mesh_file import read_target_yaml

BOMB = "\n".join(
    ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
)
REFUSED = {
    "alias bomb": (BOMB, "aliases"),
    "merged bomb": ("a: &a {x: 1}\nb: {<<: *a}", "aliases"),
    "refers to itself": ("a: &a [*a]", "aliases"),
    "deep lists": ("[" * 20000, "nested deeper"),
    "deep mappings": ("{a: " * 20000, "nested deeper"),
    "deep block": ("\n".join(" " * i + "a:" for i in range(300)), "nested deeper"),
    "no integer": ("keyframes: !!int x", "'x' is no int"),
    "empty integer": ("keyframes: !!int ''", "is no int"),
    "no float": ("a: !!float x", "is no float"),
    "no truth value": ("a: !!bool x", "is no bool"),
    "huge integer": ("a: " + "9" * 5000, "is no int"),
    "large integer": ("a: " + "9" * 400, "too large"),
    "python object": ("a: !!python/object/apply:os.getcwd []", "could not determine a constructor"),
    "binary": ("a: !!binary x", "could not determine a constructor"),
    "set": ("a: !!set {x}", "could not determine a constructor"),
    "list as key": ("? [1, 2]\n: 3", "a key must be one word"),
    "repeated key": ("a: 1\na: 2", "stands twice"),
    "two documents": ("a: 1\n---\nb: 2", "single document"),
    "tab": ("a:\n\t- b", "cannot start any token"),
    "control character": ("a: \x00", "special characters"),
    "too long": ("#" * (MAX_BYTES + 1), "longer than"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_one_sentence_from_every_reader(tmp_path, name):
    text, expected = REFUSED[name]
    path = tmp_path / "target.yaml"
    path.write_text(text)
    begun = time.process_time()  # of this process: the clock on the wall also tells what else the machine does
    for reader, error in (
        (read_yaml, ConfigError),
        (load_config, ConfigError),
        (read_target_yaml, MeshError),
        (read_camera_file, DatasetError),
    ):
        with pytest.raises(error, match=expected) as caught:
            reader(path)
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 500
    with pytest.raises(ConfigError):
        load_config("default", [f"keyframes.gap_frames={text}"])
    assert time.process_time() - begun < 5


@pytest.mark.parametrize("text", ["2024-01-01", "2024-13-45", "2001-12-14t21:59:43.10-05:00"])
def test_a_date_is_text_and_so_no_number(tmp_path, text):
    assert parse_yaml(f"a: {text}") == {"a": text}
    with pytest.raises(ConfigError, match="expected int"):
        load_config("default", [f"keyframes.gap_frames={text}"])
    (tmp_path / "target.yaml").write_text(f"mesh: {text}\n{text}: 1")
    with pytest.raises(MeshError):
        read_target_yaml(tmp_path / "target.yaml")


def test_all_presets_read_as_the_standard_loader_reads_them():
    for path in preset_folder().glob("*.yaml"):
        assert read_yaml(path) == yaml.safe_load(path.read_text())


def test_what_is_no_text_file_is_refused_at_once(tmp_path):
    fifo = tmp_path / "pipe.yaml"
    os.mkfifo(fifo)
    (tmp_path / "folder.yaml").mkdir()
    (tmp_path / "latin.yaml").write_bytes(b"a: \xe4")
    for path, text in (
        (fifo, "is not a file"),
        (tmp_path / "folder.yaml", "is not a file"),
        (tmp_path / "absent.yaml", "no such file"),
        (tmp_path / "latin.yaml", "not UTF-8"),
        (tmp_path / ("long" * 100 + ".yaml"), "cannot read"),
    ):
        with pytest.raises(ConfigError, match=text):
            read_yaml(path)
        with pytest.raises(ConfigError):
            load_config(path)


def test_random_texts_give_a_value_or_a_sentence():
    rng = random.Random(7)
    words = "a|: |\n| |- |[|]|{|}|!!|int|float|&a|*a|<<|1|.|e|~|'|>|%|@|2024-01-01|null|yes|0x|0b|1:2|?|,|#"
    n_values = 0
    for _ in range(3000):
        try:
            parse_yaml("".join(rng.choices(words.split("|"), k=rng.randint(1, 12))))
            n_values += 1
        except ConfigError as error:
            assert "\n" not in str(error)
    assert n_values > 100
