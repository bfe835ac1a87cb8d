"""What is printed of a configuration reads back as the same configuration, and says what each key means."""

import pytest
import yaml

from hat_ros.config import (
    HatConfig,
    commented_yaml,
    config_to_dict,
    differences,
    flat_options,
    load_config,
    preset_names,
    value_text,
)

OTHERWISE = (
    "fusion.relative_weight=1e-9",
    "nets.weights_folder='C:\\weights # mine: \"best\"'",
    "slam.masked=false",
    "graph.credits_replay=2",
)


@pytest.fixture(params=[*preset_names(), "changed"])
def config(request):
    return load_config("pico_hat", OTHERWISE) if request.param == "changed" else load_config(request.param)


def _read_back(text, folder):
    path = folder / "printed.yaml"
    path.write_text(text, encoding="utf-8")
    return load_config(path)


def test_all_keys_give_the_same_configuration(config, tmp_path):
    text = commented_yaml(config, flat_options())
    assert yaml.safe_load(text) == config_to_dict(config), "complete, in any reader of YAML"
    assert _read_back(text, tmp_path) == config


def test_what_differs_from_the_default_gives_the_same_configuration(config, tmp_path):
    keys = differences(HatConfig(), config)
    text = commented_yaml(config, keys)
    assert _read_back(text, tmp_path) == config
    assert sum(line.startswith(" ") and not line.split("#")[0].strip().endswith(":") for line in text.split("\n")) == (
        len(keys)
    )


def test_every_line_has_its_meaning_unit_and_symbol():
    text = commented_yaml(HatConfig(), flat_options())
    assert all("  # " in line for line in text.split("\n") if line)
    assert "\nfusion:  # Stage 4b: the causal pose\n" in text
    lines = {line.split(":")[0].strip(): line for line in text.split("\n")}
    assert lines["gate_angle_deg"].endswith(
        "# anchor and aligned SLAM rotation disagree beyond this angle [deg, paper: D]"
    )
    assert lines["gap_frames"].startswith("  gap_frames: 6      # ")
    for _, item in flat_options().values():
        assert item.metadata["doc"] in text


def test_a_section_without_one_of_the_keys_is_left_out():
    text = commented_yaml(HatConfig(), ["slam.droid.beta"])
    assert [line.split("#")[0].rstrip() for line in text.splitlines()] == ["slam:", "  droid:", "    beta: 0.3"]
    assert commented_yaml(HatConfig(), []) == ""


def test_differences_are_named_with_both_values():
    other = load_config("default", ["fusion.loss=linear", "keyframes.gap_frames=4"])
    assert differences(HatConfig(), HatConfig()) == {}
    assert differences(HatConfig(), other) == {"keyframes.gap_frames": (6, 4), "fusion.loss": ("huber", "linear")}


@pytest.mark.parametrize(
    "word", ["", "auto", "on", "null", "y: 1", "1e-3", "12", "~", "a #b", "'", '"', "\\", "two\nlines", "ä", "cuda:1"]
)
def test_any_word_survives_being_printed(word):
    text = value_text(word)
    assert "\n" not in text
    assert load_config("default", [f"nets.device={text}"]).nets.device == word


@pytest.mark.parametrize(("value", "text"), [(True, "true"), (3, "3"), (0.1, "0.1"), (1e-9, "1.0e-09"), (-2.0, "-2.0")])
def test_numbers_are_printed_as_yaml(value, text):
    assert value_text(value) == text
