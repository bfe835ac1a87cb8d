"""YAML that others wrote: plain values only, bounded in size and depth, whatever is wrong told in one sentence.

Accepted are mappings, lists, texts, numbers, true, false and null. A date is text. Aliases (``*name``) are refused:
a few of them stand for gigabytes. A key may stand only once; in the standard loader the last one wins silently.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError

from hat_ros.errors import ConfigError

MAX_BYTES = 256 * 2**10
_MAX_DEPTH = 32
_MAX_INT = 2**63
_CORE = "tag:yaml.org,2002:"


class _Loader(yaml.SafeLoader):
    """See the module's text."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """See the base class.

        Raises:
            ComposerError: an alias, or nested too deeply.
        """
        event = self.peek_event()
        where = f"in line {event.start_mark.line + 1}" if event.start_mark else ""
        if isinstance(event, yaml.AliasEvent):
            raise ComposerError(None, None, f"aliases are not accepted, repeat the value {where}", None)
        if self._depth > _MAX_DEPTH:
            raise ComposerError(None, None, f"nested deeper than {_MAX_DEPTH} {where}", None)
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """See the base class.

        Raises:
            ConstructorError: a key stands twice, or is a list or a mapping.
        """
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise ConstructorError(None, None, "a key must be one word", key.start_mark)
            if key.value in seen:
                raise ConstructorError(None, None, f"key '{key.value}' stands twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_number(self, node: yaml.ScalarNode) -> int | float | bool:
        """An integer, a float or a truth value.

        Raises:
            ConstructorError: it is none, or an integer of more than 64 bits.
        """
        kind = node.tag.removeprefix(_CORE)
        try:
            number = getattr(self, f"construct_yaml_{kind}")(node)
        except (ValueError, IndexError, KeyError, OverflowError):
            raise ConstructorError(None, None, f"'{node.value[:40]}' is no {kind}", node.start_mark) from None
        if kind == "int" and abs(number) >= _MAX_INT:
            raise ConstructorError(None, None, f"the integer {node.value[:20]}... is too large", node.start_mark)
        return number


_Loader.yaml_constructors = {
    **{_CORE + kind: _Loader.construct_number for kind in ("int", "float", "bool")},
    **{_CORE + kind: getattr(yaml.SafeLoader, f"construct_yaml_{kind}") for kind in ("null", "str", "seq", "map")},
    _CORE + "timestamp": yaml.SafeLoader.construct_yaml_str,
    None: yaml.SafeLoader.construct_undefined,
}


def parse_yaml(text: str) -> object:
    """The value that a text stands for: nested dicts and lists of str, int, float, bool and None.

    Raises:
        ConfigError: it is not valid YAML, or more than this module accepts; the message is a phrase that says what.
    """
    if len(text) > MAX_BYTES:
        raise ConfigError(f"longer than {MAX_BYTES // 2**10} KiB")
    try:
        loader = _Loader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        text = " ".join(str(error).split()).replace('in "<unicode string>", ', "in ")
        raise ConfigError(text[:300]) from None


def read_yaml(path: Path) -> object:
    """The value in a file.

    Raises:
        ConfigError: as in :func:`parse_yaml`, or the file cannot be read; the message begins with the file's name.
    """
    try:
        if not path.is_file():
            raise ConfigError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
        with path.open("rb") as stream:
            text = stream.read(MAX_BYTES + 1).decode()
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not valid YAML (byte {error.start} is not UTF-8)") from None
    try:
        return parse_yaml(text)
    except ConfigError as error:
        raise ConfigError(f"{path}: not valid YAML ({error})") from None
