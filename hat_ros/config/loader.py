"""From YAML and ``--set key=value`` to a typed configuration, and back.

Presets are package data: ``hat_ros/config/presets`` is the top-level folder ``config/``.
"""

from __future__ import annotations

import dataclasses
import difflib
import os
import re
import typing
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from hat_ros.config.option import Value
from hat_ros.config.schema import HatConfig
from hat_ros.config.yaml_text import parse_yaml, read_yaml
from hat_ros.errors import ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    Section = TypeVar("Section", bound=DataclassInstance)

# YAML 1.1 takes these for words: it wants a point in the number and a sign in the exponent.
_NUMBER_WITH_EXPONENT = re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+")


def preset_folder() -> Path:
    """Folder of the presets: the checkout's top-level ``config/``, package data of an installation."""
    return Path(str(resources.files("hat_ros.config") / "presets"))


def preset_names() -> list[str]:
    """Names accepted by ``--config`` besides files."""
    return sorted(path.stem for path in preset_folder().glob("*.yaml"))


def load_config(name_or_file: str | Path = "default", overrides: Sequence[str] = ()) -> HatConfig:
    """Read a preset by name or a YAML file, then apply ``section.key=value`` overrides (values are YAML).

    What a file does not state is as in the preset that its key ``base`` names, else as in ``default``.

    Raises:
        ConfigError: no such preset or file, not a mapping, unknown or repeated key, wrong type, value out of range.
    """
    data = _read(str(name_or_file), ())
    for override in overrides:
        _apply_override(data, override)
    return config_from_dict(data)


def config_from_dict(data: Mapping[str, Any]) -> HatConfig:
    """Typed configuration from nested mappings; anything missing is as in the ``default`` preset.

    Raises:
        ConfigError: unknown key, wrong type, value out of range.
    """
    return _build(HatConfig, data, "")


def config_to_dict(config: HatConfig) -> dict[str, Any]:
    """Nested plain mappings, complete, in declaration order."""
    return dataclasses.asdict(config)


def parse_value(text: str) -> object:
    """A value as it stands in a file or after ``--set key=``; errors of :func:`parse_yaml`."""
    return parse_yaml(text)


def flat_options(
    section: DataclassInstance | None = None, prefix: str = ""
) -> dict[str, tuple[Value, dataclasses.Field[Any]]]:
    """Dotted name -> (value, field) of every parameter of a configuration or section, in declaration order.

    The keys of ``field.metadata`` are the arguments of :func:`~hat_ros.config.option.option`: doc, level, symbol,
    unit, low, high, choices. The nodes declare the names as ROS parameters. Without an argument: the default preset.
    """
    section = HatConfig() if section is None else section
    out: dict[str, tuple[Value, dataclasses.Field[Any]]] = {}
    for item in dataclasses.fields(section):
        value = getattr(section, item.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            out.update(flat_options(value, f"{prefix}{item.name}."))
        else:
            out[f"{prefix}{item.name}"] = (value, item)
    return out


def _read(name_or_file: str, readers: tuple[str, ...]) -> dict[str, Any]:
    """What a preset or file states, on top of its base; ``readers`` are the presets that have it as their base."""
    is_file = name_or_file.endswith((".yaml", ".yml"))
    path = Path(name_or_file) if is_file else preset_folder() / f"{name_or_file}.yaml"
    if (not is_file and name_or_file not in preset_names()) or (is_file and not os.path.isfile(path)):
        known = ", ".join(preset_names())
        raise ConfigError(f"no configuration '{name_or_file}': presets are {known}, or give a .yaml file")
    data = read_yaml(path)
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: the top level must be a mapping of sections, found {type(data).__name__}")
    if "base" not in data:
        return data
    base = data.pop("base")
    if base not in preset_names() or base in (*readers, name_or_file):
        others = ", ".join(name for name in preset_names() if name not in (*readers, name_or_file))
        raise ConfigError(f"{path}: base must be one of the presets {others}; found {base!r:.80}")
    return _merged(_read(base, (*readers, name_or_file)), data)


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Nested mappings, the second on top of the first."""
    out = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(out.get(key), dict)
        out[key] = _merged(out[key], value) if both else value
    return out


def _apply_override(data: dict[str, Any], override: str) -> None:
    key, separator, value = override.partition("=")
    if not separator or not key:
        raise ConfigError(f"override '{override}' must have the form section.key=value")
    *sections, last = key.strip().split(".")
    node = data
    for section in sections:
        node = node.setdefault(section, {})
        if not isinstance(node, dict):
            raise ConfigError(f"override '{override}': '{section}' is a value, not a section")
    try:
        node[last] = parse_value(value)
    except ConfigError as error:
        raise ConfigError(f"override '{override[:80]}': the value is not valid YAML ({error})") from None


def _build(cls: type[Section], data: object, prefix: str) -> Section:
    if not isinstance(data, Mapping):
        raise ConfigError(f"{prefix.rstrip('.') or 'configuration'}: expected a mapping, found {data!r:.80}")
    known = {item.name: item for item in dataclasses.fields(cls)}
    hints = typing.get_type_hints(cls)
    values = {}
    for key, value in data.items():
        if key not in known:
            close = difflib.get_close_matches(str(key), known, n=1)
            advice = f"did you mean '{prefix}{close[0]}'?" if close else f"known keys: {', '.join(sorted(known))}"
            raise ConfigError(f"unknown key '{prefix}{key!s:.80}': {advice}")
        if dataclasses.is_dataclass(hints[key]):
            values[key] = _build(hints[key], value, f"{prefix}{key}.")
        else:
            values[key] = _check(f"{prefix}{key}", value, hints[key], known[key].metadata)
    return cls(**values)


def _check(name: str, value: object, hint: type, metadata: Mapping[str, Any]) -> Value:
    """The value as the type that the schema promises.

    Raises:
        ConfigError: another type, not a number, out of range, or none of the choices.
    """
    if hint is float and isinstance(value, str) and _NUMBER_WITH_EXPONENT.fullmatch(value):
        value = float(value)
    if hint is str and metadata["choices"] and isinstance(value, (bool, int)):
        value = str(value).lower()  # a word that YAML and ROS take for something else: true, 12
    accepts = (int, float) if hint is float else (hint,)
    if not isinstance(value, accepts) or (isinstance(value, bool) and hint is not bool):
        raise ConfigError(f"{name}: expected {hint.__name__}, found {value!r:.80} ({type(value).__name__})")
    checked: Value = hint(value)
    low, high, choices = metadata["low"], metadata["high"], metadata["choices"]
    if checked != checked:
        raise ConfigError(f"{name}: must be a number, found NaN")
    if low is not None and checked < low:
        raise ConfigError(f"{name}: must be at least {low}, found {checked}")
    if high is not None and checked > high:
        raise ConfigError(f"{name}: must be at most {high}, found {checked}")
    if choices and checked not in choices:
        raise ConfigError(f"{name}: must be one of {', '.join(choices)}, found '{checked!s:.80}'")
    return checked
