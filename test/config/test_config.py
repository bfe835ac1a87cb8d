"""Presets are complete, the published figures are in them, and mistakes are named."""

import dataclasses

import pytest
import yaml

from hat_ros.config import (
    LEVELS,
    HatConfig,
    config_from_dict,
    config_to_dict,
    flat_options,
    load_config,
    preset_folder,
    preset_names,
)
from hat_ros.errors import ConfigError

PRESETS = ("default", "mega_hat", "mega_hat_spark", "pico_hat")


def _flat(data, prefix=""):
    for key, value in data.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"


def test_the_four_presets_exist():
    assert set(PRESETS) <= set(preset_names())


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_lists_every_key_and_no_other(name):
    data = yaml.safe_load((preset_folder() / f"{name}.yaml").read_text())
    assert set(_flat(data)) == set(flat_options())


@pytest.mark.parametrize("name", PRESETS)
def test_every_key_of_a_preset_is_commented(name):
    for line in (preset_folder() / f"{name}.yaml").read_text().splitlines():
        assert not line.strip() or "#" in line, line


def test_shared_configurations_are_the_papers_table():
    mega, pico = load_config("mega_hat"), load_config("pico_hat")
    assert (mega.keyframes.gap_frames, pico.keyframes.gap_frames) == (4, 6)
    assert (mega.hypotheses.max_candidates, pico.hypotheses.max_candidates) == (10, 5)
    assert (mega.selector.score_scale, pico.selector.score_scale) == (3.0, 100.0)
    assert mega.selector.motion_weight_per_deg == pico.selector.motion_weight_per_deg == 0.3
    assert (mega.fusion.relative_weight, pico.fusion.relative_weight) == (0.002, 0.1)
    assert (mega.fusion.gate_angle_deg, pico.fusion.gate_angle_deg) == (75.0, 30.0)
    assert mega.fusion.warmup_observations == pico.fusion.warmup_observations == 4
    assert mega.fusion.huber_delta_m == pico.fusion.huber_delta_m == 0.3
    assert (mega.hypotheses.guard, pico.hypotheses.guard) == (False, True)
    assert (mega.selector.running_gate, pico.selector.running_gate) == (False, True)
    assert not (mega.prior.enabled or pico.prior.enabled or mega.refinement.enabled or pico.refinement.enabled)
    assert not (mega.selector.size_weighting or pico.selector.size_weighting)


def test_the_spark_configuration_is_the_papers_sensitivity_section():
    spark = load_config("mega_hat_spark")
    assert (spark.keyframes.gap_frames, spark.hypotheses.max_candidates) == (10, 10)
    assert (spark.selector.score_scale, spark.selector.warmup_keyframes) == (1.0, 5)
    assert (spark.fusion.relative_weight, spark.fusion.gate_angle_deg) == (0.1, 75.0)
    assert (spark.fusion.loss, spark.fusion.warmup_observations) == ("linear", 3)
    assert (spark.fusion.confidence, spark.fusion.gap_fill) == ("detection_area", "rotate")
    assert spark.selector.size_weighting
    assert spark.selector.running_gate


@pytest.mark.parametrize("name", PRESETS)
def test_what_a_run_writes_back_reads_the_same(name, tmp_path):
    config = load_config(name)
    path = tmp_path / "used.yaml"
    path.write_text(yaml.safe_dump(config_to_dict(config), sort_keys=False))
    assert load_config(path) == config


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"fusion": {"relative_wieght": 1.0}}, "did you mean 'fusion.relative_weight'"),
        ({"fusoin": {}}, "did you mean 'fusion'"),
        ({"fusion": 3}, "fusion: expected a mapping"),
        ({"fusion": {"relative_weight": "much"}}, "fusion.relative_weight: expected float"),
        ({"fusion": {"relative_weight": True}}, "fusion.relative_weight: expected float"),
        ({"fusion": {"relative_weight": float("nan")}}, "NaN"),
        ({"fusion": {"relative_weight": -1}}, "at least 0"),
        ({"fusion": {"loss": "cauchy"}}, "must be one of huber, linear"),
        ({"keyframes": {"gap_frames": 2.5}}, "expected int"),
        ({"keyframes": {"gap_frames": 0}}, "at least 1"),
        ({"hypotheses": {"max_candidates": 1000}}, "at most 64"),
        ({"prior": {"enabled": True, "delay_frames": 2}}, "credits_replay"),
    ],
)
def test_mistakes_are_named(data, message):
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        config_from_dict(data)


@pytest.mark.parametrize("text", ["a: [1", "- 1\n- 2\n", "just text", "fusion:\n  - 1\n"])
def test_yaml_that_is_no_configuration(text, tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError):
        load_config(path)


def test_an_empty_file_means_defaults(tmp_path):
    path = tmp_path / "empty.yaml"
    path.write_text("")
    assert load_config(path) == HatConfig()


def test_an_unknown_preset_names_the_known_ones():
    with pytest.raises(ConfigError, match="mega_hat"):
        load_config("giga_hat")


def test_overrides_beat_the_file_and_are_checked():
    config = load_config("default", ["fusion.relative_weight=0.5", "prior.enabled=false"])
    assert (config.fusion.relative_weight, config.prior.enabled) == (0.5, False)
    for override in ("fusion.relative_weight", "=1", "fusion.relative_weight.more=1", "fusion.relative_weight=[1"):
        with pytest.raises(ConfigError):
            load_config("default", [override])


# The unit that the end of a name promises; a count of frames has "frames".
SUFFIXES = {
    "_px": "px",
    "_deg": "deg",
    "_per_deg": "1/deg",
    "_per_frame": "deg/frame",
    "_deg_s2": "deg/s^2",
    "_radii_s2": "radii/s^2",
    "_per_rad": "m/rad",
    "_m": "m",
    "_s": "s",
    "_ms": "ms",
    "_frames": "frames",
    "_keyframes": "keyframes",
}


def test_every_option_has_a_level_and_the_unit_that_its_name_promises():
    for name, (value, item) in flat_options().items():
        assert item.metadata["level"] in LEVELS, name
        suffix = max((end for end in SUFFIXES if name.endswith(end)), key=len, default=None)
        if suffix is not None:
            assert item.metadata["unit"] == SUFFIXES[suffix], name
        if item.metadata["unit"]:
            assert type(value) in (int, float), name


def test_the_papers_symbols_stand_for_one_option_each():
    symbols = {}
    for name, (_, item) in flat_options().items():
        if item.metadata["symbol"]:
            assert item.metadata["level"] == "paper", name
            symbols.setdefault(item.metadata["symbol"], []).append(name)
    expected = {"K", "alpha", "mu", "s0", "gamma", "w_min", "lambda", "w", "D", "g", "delta"}
    assert set(symbols) == expected
    assert all(len(names) == 1 for names in symbols.values()), symbols


def test_every_option_describes_itself_and_accepts_its_default():
    for name, (value, item) in flat_options().items():
        assert item.metadata["doc"], name
        section = {}
        node = section
        *path, last = name.split(".")
        for part in path:
            node = node.setdefault(part, {})
        node[last] = value
        config_from_dict(section)
    assert dataclasses.is_dataclass(HatConfig)
