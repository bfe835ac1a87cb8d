"""From YAML and ``--set key=value`` to a typed configuration, and back.

Presets are package data: ``hat_ros/config/presets`` is the top-level folder ``config/``.
"""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from hat_ros.config.schema import HatConfig
from hat_ros.errors import ConfigError


def preset_folder() -> Path:
    """Folder of the presets: the checkout's top-level ``config/``, package data of an installation."""
    return Path(str(resources.files("hat_ros.config") / "presets"))


def preset_names() -> list[str]:
    """Names accepted by ``--config`` besides files."""
    return sorted(path.stem for path in preset_folder().glob("*.yaml"))


def load_config(name_or_file: str | Path = "default", overrides: typing.Sequence[str] = ()) -> HatConfig:
    """Read a preset by name or a YAML file, then apply ``section.key=value`` overrides (values are YAML).

    Raises:
        ConfigError: no such preset or file, not a mapping, unknown key, wrong type, value out of range.
    """
    text = str(name_or_file)
    path = Path(text) if text.endswith((".yaml", ".yml")) else preset_folder() / f"{text}.yaml"
    if not path.is_file():
        raise ConfigError(f"no configuration '{text}': presets are {', '.join(preset_names())}, or give a .yaml file")
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from None
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: the top level must be a mapping of sections, found {type(data).__name__}")
    for override in overrides:
        _apply_override(data, override)
    return config_from_dict(data)


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
        node[last] = yaml.safe_load(value)
    except yaml.YAMLError:
        raise ConfigError(f"override '{override}': the value is not valid YAML") from None


def config_from_dict(data: dict[str, Any]) -> HatConfig:
    """Typed configuration from nested mappings; anything missing keeps its default.

    Raises:
        ConfigError: unknown key, wrong type, value out of range.
    """
    return _build(HatConfig, data, "")


def config_to_dict(config: HatConfig) -> dict[str, Any]:
    """Nested plain mappings, complete, in declaration order."""
    return dataclasses.asdict(config)


def flat_options(section: Any = None, prefix: str = "") -> dict[str, tuple[Any, dataclasses.Field[Any]]]:
    """Dotted name -> (value, field) of every parameter; what the nodes declare as ROS parameters."""
    section = HatConfig() if section is None else section
    out: dict[str, tuple[Any, dataclasses.Field[Any]]] = {}
    for item in dataclasses.fields(section):
        value = getattr(section, item.name)
        if dataclasses.is_dataclass(value):
            out.update(flat_options(value, f"{prefix}{item.name}."))
        else:
            out[f"{prefix}{item.name}"] = (value, item)
    return out


def _build(cls: type, data: Any, prefix: str) -> Any:
    if not isinstance(data, dict):
        raise ConfigError(f"{prefix.rstrip('.') or 'configuration'}: expected a mapping, found {data!r}")
    known = {item.name: item for item in dataclasses.fields(cls)}
    hints = typing.get_type_hints(cls)
    values = {}
    for key, value in data.items():
        if key not in known:
            close = difflib.get_close_matches(str(key), known, n=1)
            advice = f"did you mean '{prefix}{close[0]}'?" if close else f"known keys: {', '.join(sorted(known))}"
            raise ConfigError(f"unknown key '{prefix}{key}': {advice}")
        if dataclasses.is_dataclass(hints[key]):
            values[key] = _build(hints[key], value, f"{prefix}{key}.")
        else:
            values[key] = _check(f"{prefix}{key}", value, hints[key], known[key].metadata)
    return cls(**values)


def _check(name: str, value: Any, hint: Any, metadata: typing.Mapping[str, Any]) -> Any:
    if isinstance(hint, types.UnionType):
        if value is None and type(None) in hint.__args__:
            return None
        hint = next(arg for arg in hint.__args__ if arg is not type(None))
    accepts = {float: (int, float), int: (int,), bool: (bool,), str: (str,)}[hint]
    if not isinstance(value, accepts) or (isinstance(value, bool) and hint is not bool):
        raise ConfigError(f"{name}: expected {hint.__name__}, found {value!r} ({type(value).__name__})")
    value = hint(value)
    low, high, choices = metadata.get("low"), metadata.get("high"), metadata.get("choices")
    if hint is float and value != value:
        raise ConfigError(f"{name}: must be a number, found NaN")
    if low is not None and value < low:
        raise ConfigError(f"{name}: must be at least {low}, found {value}")
    if high is not None and value > high:
        raise ConfigError(f"{name}: must be at most {high}, found {value}")
    if choices and value not in choices:
        raise ConfigError(f"{name}: must be one of {', '.join(choices)}, found '{value}'")
    return value
