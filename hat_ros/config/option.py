"""One parameter of the configuration: its default, and what people and checks need to know about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Any, Literal, TypeVar, get_args

Level = Literal["basic", "paper", "expert"]
"""Who sets a parameter.

``basic``: every user, to say what there is (backends, device, memory, what is on). ``paper``: users who repeat or vary
a published experiment; the value is in the HAT paper, in its authors' reference, or in the paper of a network.
``expert``: a tuned constant; change it with a measurement at hand.
"""

LEVELS: tuple[Level, ...] = get_args(Level)

Value = bool | int | float | str

T = TypeVar("T", bool, int, float, str)


def option(
    default: T,
    doc: str,
    *,
    level: Level = "expert",
    symbol: str = "",
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> T:
    """A dataclass field with its description and what values it accepts.

    Args:
        default: value in the ``default`` preset.
        doc: one line, without unit and symbol.
        level: who sets it, see :data:`Level`.
        symbol: of the HAT paper, in ASCII (``alpha``, ``s0``); empty where the paper has none.
        unit: of the value (``px``, ``deg``, ``frames``, ``m/rad``); empty for a pure number or a word.
        low: smallest accepted number.
        high: largest accepted number.
        choices: the accepted words; empty: any.

    Returns:
        What :func:`dataclasses.field` returns; the arguments but ``default`` are the keys of its ``metadata``.
    """
    about = {"doc": doc, "level": level, "symbol": symbol, "unit": unit, "low": low, "high": high, "choices": choices}
    return field(default=default, metadata=about)


def describe(metadata: Mapping[str, Any]) -> str:
    """The description of a parameter with its unit and the paper's symbol, on one line."""
    symbol = f"paper: {metadata['symbol']}" if metadata["symbol"] else ""
    extra = ", ".join(part for part in (metadata["unit"], symbol) if part)
    return f"{metadata['doc']} [{extra}]" if extra else metadata["doc"]
