"""Presets state what differs, the published figures are in them, and mistakes are named."""

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


def _stated(name):
    return yaml.safe_load((preset_folder() / f"{name}.yaml").read_text()) or {}


def test_the_default_preset_is_the_configuration_as_constructed():
    assert load_config("default") == load_config() == config_from_dict({}) == HatConfig()
    assert _stated("default") == {}


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_states_only_what_differs_from_its_base(name):
    base = {key: value for key, (value, _) in flat_options(load_config(_stated(name).get("base", "default"))).items()}
    values = {key: value for key, (value, _) in flat_options(load_config(name)).items()}
    stated = set(_flat(_stated(name))) - {"base"}
    assert stated == {key for key in values if values[key] != base[key]}


# Every value of the published method, by what shares it; mega_hat_spark has what mega_hat has unless stated.
SHARED = {
    "keyframes.settled_factor": 1,
    "segmentation.backend": "mask2former",
    "hypotheses.megapose.refiner_iterations": 5,
    "segmentation.pose_region": "detection",
    "hypotheses.megapose.box_padding": 0.1,
    "hypotheses.picopose.ransac_threshold_px": 2.0,
    "hypotheses.picopose.ransac_iterations": 150,
    "slam.backend": "droid",
    "slam.masked": True,
    "slam.droid.input_area_px": 196608,
    "slam.droid.warmup_keyframes": 8,
    "slam.droid.filter_threshold": 2.4,
    "slam.droid.keyframe_threshold": 4.0,
    "slam.droid.beta": 0.3,
    "slam.droid.frontend_threshold": 16.0,
    "slam.droid.frontend_window": 25,
    "slam.droid.frontend_radius": 2,
    "slam.droid.frontend_nms": 1,
    "slam.droid.motion_damping": 0.0,
    "slam.droid.readout_updates": 3,
    "slam.droid.readout_depths": False,
    "slam.droid.as_released": True,
    "slam.droid.backend_threshold": 22.0,
    "slam.droid.backend_radius": 2,
    "slam.droid.backend_nms": 3,
    "selector.motion_weight_per_deg": 0.3,
    "selector.max_motion_penalty": 0.0,
    "selector.max_turn_deg_per_frame": 0.0,
    "selector.gate_neighbourhood_deg": 15.0,
    "selector.gate_min_median_support": 2.0,
    "selector.gate_max_override_share": 0.7,
    "selector.size_ref_px": 500.0,
    "selector.size_exponent": 2.0,
    "selector.size_weight_min": 0.05,
    "alignment.lever_m_per_rad": 1.0,
    "alignment.min_observations": 3,
    "alignment.refit_interval_frames": 10,
    "alignment.rejection_factor": 3.0,
    "alignment.first_rejection_rounds": 2,
    "alignment.refit_rejection_rounds": 0,
    "alignment.reset_anchors": 4,
    "fusion.inertial_weight": 0.0,
    "fusion.gate_weight": 0.05,
    "fusion.huber_delta_m": 0.3,
    "fusion.confidence_exponent": 1.0,
    "fusion.coast_limit_frames": 0,
    "refinement.enabled": False,
    "prior.enabled": False,
}
MEGA_HAT = {
    "keyframes.gap_frames": 4,
    "hypotheses.backend": "megapose",
    "hypotheses.max_candidates": 10,
    "hypotheses.guard": False,
    "selector.score_scale": 3.0,
    "selector.warmup_keyframes": 3,
    "selector.running_gate": False,
    "selector.size_weighting": False,
    "fusion.relative_weight": 0.002,
    "fusion.gate_angle_deg": 75.0,
    "fusion.loss": "huber",
    "fusion.warmup_observations": 4,
    "fusion.confidence": "uniform",
    "fusion.gap_fill": "hold",
}
PUBLISHED = {
    "mega_hat": MEGA_HAT,
    "pico_hat": MEGA_HAT
    | {
        "keyframes.gap_frames": 6,
        "hypotheses.backend": "picopose",
        "hypotheses.max_candidates": 5,
        "hypotheses.guard": True,
        "selector.score_scale": 100.0,
        "selector.running_gate": True,
        "fusion.relative_weight": 0.1,
        "fusion.gate_angle_deg": 30.0,
    },
    "mega_hat_spark": MEGA_HAT
    | {
        "keyframes.gap_frames": 10,
        "selector.score_scale": 1.0,
        "selector.warmup_keyframes": 5,
        "selector.running_gate": True,
        "selector.size_weighting": True,
        "fusion.relative_weight": 0.1,
        "fusion.loss": "linear",
        "fusion.warmup_observations": 3,
        "fusion.confidence": "detection_area",
        "fusion.gap_fill": "rotate",
    },
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_configuration_does_not_move_with_the_defaults(name):
    """Paper: Table "Shared temporal configurations", Sec. "Hyperparameter Sensitivity"; the authors' reference."""
    values = {key: value for key, (value, _) in flat_options(load_config(name)).items()}
    published = SHARED | PUBLISHED[name]
    assert {key: values[key] for key in published} == published


def test_every_option_of_the_level_paper_is_pinned():
    levels = {key for key, (_, item) in flat_options().items() if item.metadata["level"] == "paper"}
    assert levels <= set(SHARED | MEGA_HAT)


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


@pytest.mark.parametrize("text", ["", "# nothing\n", "base: default\n"])
def test_a_file_that_states_nothing_means_the_default_preset(text, tmp_path):
    path = tmp_path / "empty.yaml"
    path.write_text(text)
    assert load_config(path) == HatConfig()


def test_a_file_starts_from_the_preset_that_it_names(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("fusion: {relative_weight: 0.5}\n")
    assert load_config(path) == load_config("default", ["fusion.relative_weight=0.5"])
    path.write_text("base: mega_hat_spark\nfusion: {relative_weight: 0.5}\n")
    assert load_config(path) == load_config("mega_hat_spark", ["fusion.relative_weight=0.5"])


@pytest.mark.parametrize("base", ["nope", "mine.yaml", "3", "[mega_hat]"])
def test_a_base_must_be_a_preset(base, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(f"base: {base}\n")
    with pytest.raises(ConfigError, match="base must be one of the presets default, mega_hat"):
        load_config(path)


def test_presets_based_on_each_other_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("hat_ros.config.loader.preset_folder", lambda: tmp_path)
    for name, base in (("one", "two"), ("two", "one"), ("three", "three"), ("four", "default"), ("default", "four")):
        (tmp_path / f"{name}.yaml").write_text(f"base: {base}\n")
    for name in ("one", "two", "three", "four", "default"):
        with pytest.raises(ConfigError, match="base must be one of the presets"):
            load_config(name)


@pytest.mark.parametrize(
    "text", ["a: 1\na: 2\n", "fusion:\n  loss: huber\n  loss: linear\n", "fusion: {}\nfusion: {}\n"]
)
def test_a_key_that_stands_twice_is_an_error(text, tmp_path):
    path = tmp_path / "twice.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"twice\.yaml: .*key '(a|loss|fusion)' stands twice in line [23]"):
        load_config(path)


def test_a_file_that_cannot_be_read_is_named(tmp_path, monkeypatch):
    path = tmp_path / "mine.yaml"
    path.write_text("")

    def denied(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(type(path), "open", denied)
    with pytest.raises(ConfigError, match=r"cannot read .*mine\.yaml: Permission denied"):
        load_config(path)


@pytest.mark.parametrize("word", ["1e-3", "2026", "on", "0.5"])
def test_a_word_that_looks_like_a_value_survives_what_a_run_writes_back(word, tmp_path):
    config = load_config("default", [f"nets.weights_folder='{word}'"])
    path = tmp_path / "used.yaml"
    path.write_text(yaml.safe_dump(config_to_dict(config), sort_keys=False))
    assert load_config(path) == config


@pytest.mark.parametrize("text", ["1e-3", "1E-3", "1.e-3", "+1e-03", "0.001", "1.0e-3"])
def test_a_number_with_an_exponent_is_a_number(text, tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(f"fusion:\n  relative_weight: {text}\n")
    assert load_config(path).fusion.relative_weight == 1e-3
    assert load_config("default", [f"fusion.relative_weight={text}"]).fusion.relative_weight == 1e-3


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


@pytest.mark.parametrize(("text", "word"), [("true", "true"), ("false", "false"), ("auto", "auto"), ("'true'", "true")])
def test_words_that_yaml_takes_for_something_else_stay_words(text, word):
    assert load_config("default", [f"camera.rectified={text}"]).camera.rectified == word


@pytest.mark.parametrize(("text", "word"), [("12", "12"), ("16", "16"), ("auto", "auto")])
def test_a_depth_is_a_word_or_a_number(text, word):
    assert load_config("default", [f"camera.image_depth={text}"]).camera.image_depth == word


@pytest.mark.parametrize("override", ["camera.rectified=1", "camera.image_depth=7", "camera.image_depth=true"])
def test_other_words_are_refused(override):
    with pytest.raises(ConfigError, match="must be one of auto"):
        load_config("default", [override])
