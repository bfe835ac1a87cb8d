"""``hat config``: what is printed is a configuration, and mistakes are one sentence."""

import pytest

from hat_ros.cli import config as config_command
from hat_ros.cli import main
from hat_ros.config import LEVELS, flat_options, load_config, preset_names


def _printed(capsys, *arguments):
    assert main(["config", *arguments]) == 0
    return capsys.readouterr().out


def _keys(text):
    """Dotted names that a text states."""
    names, path = [], []
    for line in text.splitlines():
        entry = line.split("#")[0].rstrip()
        if not entry:
            continue
        depth = (len(entry) - len(entry.lstrip())) // 2
        key, _, value = entry.strip().partition(":")
        path = [*path[:depth], key]
        if value:
            names.append(".".join(path))
    return names


@pytest.mark.parametrize("name", preset_names())
@pytest.mark.parametrize("extent", [[], ["--all"]])
def test_what_show_prints_is_the_configuration(name, extent, capsys, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(_printed(capsys, "show", name, *extent))
    assert load_config(path) == load_config(name)
    assert main(["config", "diff", str(path), name]) == 0
    assert capsys.readouterr().out == ""


def test_show_prints_what_differs(capsys):
    text = _printed(capsys, "show", "mega_hat", "--set", "keyframes.gap_frames=9")
    assert text.startswith("# mega_hat --set keyframes.gap_frames=9: what differs from the default preset")
    assert "  gap_frames: 9 " in text
    assert "fusion.relative_weight" in _keys(text)
    assert "fusion.huber_delta_m" not in _keys(text)


def test_the_default_shows_its_basic_keys_and_a_changed_one_only_that(capsys):
    levels = {key: item.metadata["level"] for key, (_, item) in flat_options().items()}
    assert set(_keys(_printed(capsys, "show"))) == {key for key in levels if levels[key] == "basic"}
    assert _keys(_printed(capsys, "show", "--set", "fusion.loss=linear")) == ["fusion.loss"]


def test_levels_part_the_keys(capsys):
    assert config_command.LEVELS == LEVELS
    by_level = [set(_keys(_printed(capsys, "show", "pico_hat", "--level", level))) for level in LEVELS]
    assert set.union(*by_level) == set(flat_options())
    assert sum(map(len, by_level)) == len(flat_options())
    assert "selector.score_scale" in by_level[LEVELS.index("paper")]


def test_diff_names_each_key_that_differs(capsys):
    assert _printed(capsys, "diff", "mega_hat", "mega_hat_spark").splitlines() == [
        "keyframes.gap_frames: 4 -> 10",
        "selector.score_scale: 3.0 -> 1.0",
        "selector.warmup_keyframes: 3 -> 5",
        "selector.running_gate: false -> true",
        "selector.size_weighting: false -> true",
        "fusion.relative_weight: 0.002 -> 0.1",
        "fusion.loss: huber -> linear",
        "fusion.warmup_observations: 4 -> 3",
        "fusion.confidence: uniform -> detection_area",
        "fusion.gap_fill: hold -> rotate",
    ]
    assert _printed(capsys, "diff", "pico_hat", "pico_hat") == ""


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["show", "nope"], "no configuration 'nope'"),
        (["show", "{tmp}/none.yaml"], "no configuration"),
        (["show", "{tmp}/twice.yaml"], "key 'loss' stands twice"),
        (["show", "--set", "fusion.los=huber"], "did you mean 'fusion.loss'"),
        (["show", "--set", "fusion.loss"], "section.key=value"),
        (["show", "--set", "prior.delay_frames=2"], "at least graph.credits_replay"),
        (["diff", "default", "nope"], "no configuration 'nope'"),
    ],
)
def test_mistakes_are_one_sentence(arguments, complaint, capsys, tmp_path):
    (tmp_path / "twice.yaml").write_text("fusion:\n  loss: huber\n  loss: linear\n")
    assert main(["config", *(argument.format(tmp=tmp_path) for argument in arguments)]) == 2
    error = capsys.readouterr().err
    assert complaint in error
    assert error.startswith("hat: ")
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    "arguments", [[], ["show", "--all", "--level", "basic"], ["show", "--level", "some"], ["diff", "a"]]
)
def test_wrong_usage_is_told_by_the_parser(arguments):
    with pytest.raises(SystemExit) as stop:
        main(["config", *arguments])
    assert stop.value.code == 2
