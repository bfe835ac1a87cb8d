#!/usr/bin/env python3
"""How large the package is: rooms, arrows between them, lines, constants, configuration keys.

Two columns. ``default``: the modules that the default preset really loads, found by running it: a process of its own
tracks a rendered box for a few frames with ``HatTracker`` and lists what was imported. ``package``: everything.

A room is a folder with modules, or a module that lies directly in the package. An arrow leads from a room to another
one that it imports anywhere, in functions and for type checking as well. Lines of code are those that are neither blank
nor comment nor docstring. A tuned constant is a number in the value of a module-level name in capitals: each number of
a tuple, list, dict or call counts, an expression of numbers alone counts once, one of other names not at all. A member
that may be None is an attribute that a method sets to None, or declares with ``None`` in its type.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import os
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]
LONG_FUNCTION, LONG_MODULE = 40, 300

# Runs in the checkout that is counted, which may be an older one: only names that it always had are used.
_PROBE = """
import dataclasses, json, sys, tempfile
from pathlib import Path
import numpy as np, trimesh
from hat_ros.config import load_config
from hat_ros.tracker import HatTracker
from hat_ros.types import Camera, Frame

def keys(section):
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if dataclasses.is_dataclass(value):
            yield from keys(value)
        else:
            yield field.metadata.get("level", "")

config = load_config("default")
try:
    from hat_ros import load_target
except ImportError:
    from hat_ros.target import load_target
with tempfile.TemporaryDirectory() as folder:
    trimesh.creation.box((1.0, 0.7, 0.4)).export(Path(folder) / "box.ply")
    tracker = HatTracker(config, load_target(Path(folder) / "box.ply"))
camera = Camera(np.array([[300.0, 0, 79.5], [0, 300.0, 59.5], [0, 0, 1]]), 160, 120)
image = np.zeros((120, 160, 3), np.uint8)
image[35:85, 40:120] = np.linspace(60, 220, 80, dtype=np.uint8)[None, :, None]
for index in range(6):
    tracker.step(Frame(10**9 + index * 10**8, np.roll(image, index, axis=1), camera))
loaded = [m.__file__ for name, m in sys.modules.items() if name.split(".")[0] == "hat_ros" and m.__file__]
print(json.dumps({"files": loaded, "keys": list(keys(config))}))
"""


@dataclass(frozen=True)
class Module:
    """One source file.

    Attributes:
        path: relative to the package's folder.
        source: its text.
    """

    path: Path
    source: str

    @cached_property
    def tree(self) -> ast.Module:
        """The parsed source."""
        return ast.parse(self.source)

    @property
    def name(self) -> str:
        """Dotted name below the package; of a folder's ``__init__``, the folder's."""
        parts = self.path.with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    @property
    def room(self) -> str:
        """The folder it lies in, or its own name."""
        return ".".join(self.path.parts[:-1]) or self.path.stem

    @property
    def lines(self) -> int:
        """All lines."""
        return len(self.source.splitlines())

    @property
    def code_lines(self) -> int:
        """Lines that are neither blank nor comment nor docstring."""
        skip = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
        used: set[int] = set()
        for token in tokenize.generate_tokens(io.StringIO(self.source).readline):
            if token.type not in skip:
                used.update(range(token.start[0], token.end[0] + 1))
        for node in ast.walk(self.tree):
            if (
                isinstance(node, ast.Expr)
                and isinstance(node.value, ast.Constant)
                and isinstance(node.value.value, str)
            ):
                used.difference_update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        return len(used)

    def imports(self) -> Iterator[str]:
        """Dotted names below the package that it imports; a name from a module as well as the module."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Import):
                yield from (alias.name.removeprefix("hat_ros.") for alias in node.names if "hat_ros." in alias.name)
            elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "hat_ros":
                below = (node.module or "").removeprefix("hat_ros").lstrip(".")
                yield from (f"{below}.{alias.name}".lstrip(".") for alias in node.names)

    def functions(self) -> Iterator[int]:
        """Lengths of its functions in lines, docstring included."""
        for node in ast.walk(self.tree):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                yield (node.end_lineno or node.lineno) - node.lineno + 1

    def constants(self) -> int:
        """Tuned constants."""
        found = 0
        for node in self.tree.body:
            if isinstance(node, ast.Assign):
                names = {item.id for target in node.targets for item in ast.walk(target) if isinstance(item, ast.Name)}
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                names = {node.target.id}
            else:
                continue
            if node.value is not None and any(re.fullmatch(r"_*[A-Z][A-Z0-9_]*", name) for name in names):
                found += _numbers(node.value)
        return found

    def optional_members(self) -> int:
        """Attributes of ``self`` that are None at some time."""
        found: set[tuple[int, str]] = set()
        for owner in (node for node in ast.walk(self.tree) if isinstance(node, ast.ClassDef)):
            for node in ast.walk(owner):
                pairs: list[tuple[ast.expr, bool]] = []
                if isinstance(node, ast.AnnAssign):
                    pairs = [(node.target, bool(re.search(r"\bNone\b|Optional", ast.unparse(node.annotation))))]
                elif isinstance(node, ast.Assign):
                    pairs = [pair for target in node.targets for pair in _assigned_none(target, node.value)]
                for target, may_be_none in pairs:
                    if may_be_none and isinstance(target, ast.Attribute) and ast.unparse(target.value) == "self":
                        found.add((owner.lineno, target.attr))
        return len(found)


def _assigned_none(target: ast.expr, value: ast.expr) -> Iterator[tuple[ast.expr, bool]]:
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and len(target.elts) == len(value.elts):
        for one, its_value in zip(target.elts, value.elts, strict=True):
            yield from _assigned_none(one, its_value)
    else:
        yield target, isinstance(value, ast.Constant) and value.value is None


def _numbers(value: ast.expr) -> int:
    """Numbers that someone chose in the value of a constant."""
    if isinstance(value, ast.Constant):
        return int(isinstance(value.value, (int, float)) and not isinstance(value.value, bool))
    if isinstance(value, ast.UnaryOp):
        return _numbers(value.operand)
    if isinstance(value, ast.BinOp):
        leaves = [node for node in ast.walk(value) if isinstance(node, (ast.Name, ast.Call, ast.Attribute))]
        return (
            1 if not leaves else sum(_numbers(side) for side in (value.left, value.right) if isinstance(side, ast.Call))
        )
    if isinstance(value, (ast.Tuple, ast.List, ast.Set)):
        return sum(map(_numbers, value.elts))
    if isinstance(value, ast.Dict):
        return sum(map(_numbers, value.values))
    if isinstance(value, ast.Call):
        return sum(map(_numbers, [*value.args, *(keyword.value for keyword in value.keywords)]))
    return 0


def arrows(modules: Iterable[Module], every: dict[str, Module]) -> set[tuple[str, str]]:
    """(room, other room that it imports), among the modules."""
    rooms = {module.room for module in modules}
    found = set()
    for module in modules:
        for name in module.imports():
            target = every.get(name) or every.get(name.rpartition(".")[0])
            if target is not None and target.room != module.room and target.room in rooms:
                found.add((module.room, target.room))
    return found


def floors(rooms: set[str], found: set[tuple[str, str]]) -> tuple[int, int]:
    """Rooms on the longest chain of arrows, those of a circle counted as one; and how many rooms lie in circles."""
    reach = {room: {b for a, b in found if a == room} for room in rooms}
    for middle in rooms:
        for room in rooms:
            if middle in reach[room]:
                reach[room] |= reach[middle]
    height: dict[str, int] = {}
    for room in sorted(rooms, key=lambda room: len(reach[room] | {room})):
        height[room] = 1 + max((height[b] for b in reach[room] if room not in reach[b]), default=0)
    return max(height.values(), default=0), sum(room in reach[room] for room in rooms)


def figures(modules: list[Module], every: dict[str, Module]) -> dict[str, int]:
    """All counts over some modules."""
    real = [module for module in modules if module.source.strip()]
    inner = [module for module in real if module.name]  # the package's own __init__ is its entrance, no room
    rooms, found = {module.room for module in inner}, arrows(inner, every)
    storeys, circular = floors(rooms, found)
    lengths = [length for module in real for length in module.functions()]
    return {
        "rooms": len(rooms),
        "floors": storeys,
        "rooms in circles": circular,
        "arrows": len(found),
        "files": len(real),
        "lines": sum(module.lines for module in real),
        "lines of code": sum(module.code_lines for module in real),
        "functions": len(lengths),
        f"functions over {LONG_FUNCTION} lines": sum(length > LONG_FUNCTION for length in lengths),
        f"modules over {LONG_MODULE} lines": sum(module.lines > LONG_MODULE for module in real),
        "tuned constants": sum(module.constants() for module in real),
        "members that may be None": sum(module.optional_members() for module in real),
    }


def probe(root: Path) -> dict[str, Any]:
    """Files that the default preset loads and the levels of all configuration keys."""
    environment = os.environ | {"PYTHONPATH": str(root)}
    command = [sys.executable, "-c", _PROBE]
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"count: the default preset of {root} does not run:\n{done.stderr}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def mypy_errors(root: Path) -> int:
    """Errors of mypy over the package, by this checkout's settings.

    Raises:
        SystemExit: mypy is not installed.
    """
    command = [sys.executable, "-m", "mypy", "--config-file", str(HERE / "pyproject.toml"), "-p", "hat_ros"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    last = done.stdout.strip().splitlines()[-1:] or [done.stderr.strip()]
    if last[0].startswith("Success"):
        return 0
    found = re.match(r"Found (\d+) error", last[0])
    if found is None:
        sys.exit(f"count: mypy does not run: {last[0]}")
    return int(found[1])


def count(root: Path, with_mypy: bool = False) -> dict[str, Any]:
    """All figures of a checkout: of the default preset, of the package, and of the configuration."""
    package = root / "hat_ros"
    paths = sorted(package.rglob("*.py"))
    modules = [Module(path.relative_to(package), path.read_text(encoding="utf-8")) for path in paths]
    every = {module.name: module for module in modules}
    measured = probe(root)
    loaded = {Path(file).resolve() for file in measured["files"]}
    flown = [module for module in modules if (package / module.path).resolve() in loaded]
    out: dict[str, Any] = {"default": figures(flown, every), "package": figures(modules, every)}
    levels: list[str] = measured["keys"]
    out["keys"] = {"all": len(levels)} | {level: levels.count(level) for level in dict.fromkeys(levels) if level}
    if with_mypy:
        out["mypy errors"] = mypy_errors(root)
    return out


def text(found: dict[str, Any]) -> str:
    """The figures as a table."""
    lines = [f"{'':32}{'default':>10}{'package':>10}"]
    lines += [f"{name:32}{value:>10}{found['package'][name]:>10}" for name, value in found["default"].items()]
    levels = ", ".join(f"{level} {number}" for level, number in found["keys"].items() if level != "all")
    lines.append(f"{'configuration keys':32}{found['keys']['all']:>10}" + (f"  ({levels})" if levels else ""))
    if "mypy errors" in found:
        lines.append(f"{'mypy errors':32}{'':10}{found['mypy errors']:>10}")
    return "\n".join(lines)


def main() -> None:
    """Count and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=HERE, metavar="PATH", help="another checkout (default: this one)")
    parser.add_argument("--mypy", action="store_true", help="count the errors of mypy as well")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    found = count(arguments.root.resolve(), arguments.mypy)
    print(json.dumps(found, indent=2) if arguments.json else text(found))


if __name__ == "__main__":
    main()
