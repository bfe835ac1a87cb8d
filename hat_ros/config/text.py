"""A configuration as commented YAML, and what differs between two."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection
from typing import TYPE_CHECKING

import yaml

from hat_ros.config.loader import flat_options, parse_value
from hat_ros.config.option import Value, describe
from hat_ros.config.schema import HatConfig

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def differences(first: HatConfig, second: HatConfig) -> dict[str, tuple[Value, Value]]:
    """Dotted name -> (first value, second value) of every parameter that differs, in declaration order."""
    others = flat_options(second)
    return {key: (value, others[key][0]) for key, (value, _) in flat_options(first).items() if value != others[key][0]}


def commented_yaml(config: HatConfig, keys: Collection[str]) -> str:
    """The parameters of these dotted names, each with its meaning, unit and symbol; ends with a newline.

    A file with all names gives the same configuration, and so does one with those that differ from the default preset.
    """
    return "\n".join(
        f"{name}:  # {_title(section)}\n{text}"
        for name, section in _subsections(config).items()
        if (text := _section(section, f"{name}.", keys, 1))
    )


def value_text(value: Value) -> str:
    """The value as it stands in YAML and after ``--set key=``, on one line."""
    if isinstance(value, str):
        plain = value.isidentifier() and parse_value(value) == value
        return value if plain else json.dumps(value, ensure_ascii=False)
    return yaml.safe_dump(value).split("\n")[0]


def _section(section: DataclassInstance, prefix: str, keys: Collection[str], depth: int) -> str:
    """The lines of one section, those of the sections in it after its own; empty without one of the keys."""
    indent = "  " * depth
    nested = _subsections(section)
    own = [item for item in dataclasses.fields(section) if item.name not in nested and f"{prefix}{item.name}" in keys]
    entries = [f"{indent}{item.name}: {value_text(getattr(section, item.name))}" for item in own]
    width = max(map(len, entries), default=0)
    text = "".join(f"{entry:<{width}}  # {describe(item.metadata)}\n" for entry, item in zip(entries, own, strict=True))
    for name, inner in nested.items():
        if inner_text := _section(inner, f"{prefix}{name}.", keys, depth + 1):
            text += f"{indent}{name}:  # {_title(inner)}\n{inner_text}"
    return text


def _subsections(section: DataclassInstance) -> dict[str, DataclassInstance]:
    values = {item.name: getattr(section, item.name) for item in dataclasses.fields(section)}
    return {
        name: value for name, value in values.items() if dataclasses.is_dataclass(value) and not isinstance(value, type)
    }


def _title(section: DataclassInstance) -> str:
    return (section.__doc__ or "").split("\n")[0].rstrip(".")
