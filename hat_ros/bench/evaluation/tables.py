"""One table, four notations: text, CSV, LaTeX, JSON. Same rows, same bytes for the same figures."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_LATEX = {character: "\\" + character for character in "&%$#_{}"} | {
    "<": "$<$",
    ">": "$>$",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\\": r"\textbackslash{}",
}


@dataclass(frozen=True)
class Column:
    """A column of figures.

    Attributes:
        key: name in the rows.
        title: heading for people.
        form: format of numbers, ``str`` for text.
        latex: heading for LaTeX; the title when empty.
    """

    key: str
    title: str
    form: str = ""
    latex: str = ""

    def text(self, row: dict[str, Any]) -> str:
        """The cell of a row, ``-`` when there is no figure."""
        value = row.get(self.key)
        if _finite(value) is None:
            return "-"
        return format(value, self.form) if self.form else str(value)


@dataclass(frozen=True)
class Table:
    """Rows of figures under named columns."""

    title: str
    columns: Sequence[Column]
    rows: Sequence[dict[str, Any]]

    def text(self) -> str:
        """Aligned plain text."""
        cells = [[column.title for column in self.columns]]
        cells += [[column.text(row) for column in self.columns] for row in self.rows]
        widths = [max(len(line[i]) for line in cells) for i in range(len(self.columns))]
        lines = []
        for line in cells:
            padded = (
                cell.rjust(width) if column.form else cell.ljust(width)
                for cell, width, column in zip(line, widths, self.columns, strict=True)
            )
            lines.append("  ".join(padded).rstrip())
        lines.insert(1, "  ".join("-" * width for width in widths))
        return f"{self.title}\n" + "\n".join(lines) + "\n"

    def csv(self) -> str:
        """Comma-separated, full precision, keys as heading."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow([column.key for column in self.columns])
        for row in self.rows:
            writer.writerow(["" if row.get(column.key) is None else row[column.key] for column in self.columns])
        return out.getvalue()

    def latex(self) -> str:
        """A ``booktabs`` tabular."""
        alignment = "".join("r" if column.form else "l" for column in self.columns)
        lines = [rf"\begin{{tabular}}{{@{{}}{alignment}@{{}}}}", r"\toprule"]
        lines.append(" & ".join(column.latex or _escape(column.title) for column in self.columns) + r" \\")
        lines.append(r"\midrule")
        lines += [" & ".join(_escape(column.text(row)) for column in self.columns) + r" \\" for row in self.rows]
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"

    def json(self) -> str:
        """Title, columns and rows, full precision; null where there is no figure."""
        rows = [{column.key: _finite(row.get(column.key)) for column in self.columns} for row in self.rows]
        return json.dumps({"title": self.title, "rows": rows}, indent=2, allow_nan=False) + "\n"

    def write(self, folder: Path, name: str) -> None:
        """All notations: ``name.txt``, ``.csv``, ``.tex``, ``.json``."""
        for suffix, text in (("txt", self.text()), ("csv", self.csv()), ("tex", self.latex()), ("json", self.json())):
            (folder / f"{name}.{suffix}").write_text(text, encoding="utf-8")


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _escape(text: str) -> str:
    """Text as LaTeX prints it; ``<`` and ``>`` are other characters in its default fonts."""
    return "".join(_LATEX.get(character, character) for character in text)
