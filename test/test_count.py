"""What `make count` counts, on modules made by hand."""

import ast
import importlib.util
import sys
from pathlib import Path

import pytest

SPEC = importlib.util.spec_from_file_location("count", Path(__file__).parents[1] / "tools" / "count.py")
count = importlib.util.module_from_spec(SPEC)
sys.modules["count"] = count
SPEC.loader.exec_module(count)


def module(path, source):
    return count.Module(Path(path), source)


@pytest.mark.parametrize(
    ("source", "numbers"),
    [
        ("LIMIT = 3.0", 1),
        ("_LIMIT = -3", 1),
        ("_PAIR: tuple[int, int] = (1, 2)", 2),
        ("A, B = 1, 2", 2),
        ("BYTES = 16 * 2**20", 1),
        ("NAMES = {'a': 1.0, 'b': (2, 3)}", 3),
        ("RULE = Schedule(4, factor=0.5, name='x')", 2),
        ("HALF = LIMIT / 2", 0),
        ("ENABLED = True", 0),
        ("limit = 3.0", 0),
        ("def f():\n    LIMIT = 3.0", 0),
    ],
)
def test_tuned_constants(source, numbers):
    assert module("x.py", source).constants() == numbers


def test_lines_of_code_are_neither_blank_nor_comment_nor_docstring():
    source = (
        '"""Doc\nstring."""\n\n# a comment\nx = (\n    1,\n)\n\n\ndef f():\n    """Says."""\n    return x  # here\n'
    )
    assert module("x.py", source).code_lines == 5
    assert list(module("x.py", source).functions()) == [3]


def test_members_that_may_be_none():
    source = """
class A:
    field: int | None = None
    def __init__(self):
        self.a, self.b = None, 1
        self.c: int | None = 2
        self.d: int = 3
    def start(self):
        self.d = None
"""
    ast.parse(source)
    assert module("x.py", source).optional_members() == 3


def test_rooms_arrows_floors_and_circles():
    modules = [
        module("types.py", "x = 1"),
        module("core/a.py", "from hat_ros.types import x\nfrom hat_ros.core import b"),
        module("core/b.py", "def f():\n    from hat_ros.io.bag import g"),
        module("io/bag.py", "from hat_ros import types\nfrom hat_ros.core.a import y"),
        module("app/run/top.py", "import hat_ros.io.bag"),
    ]
    every = {item.name: item for item in modules}
    found = count.arrows(modules, every)
    expected = {("core", "types"), ("core", "io"), ("io", "types"), ("io", "core"), ("app.run", "io")}
    assert found == expected
    assert count.floors({item.room for item in modules}, found) == (3, 2)
    assert count.arrows(modules[:2], every) == {("core", "types")}, "arrows to what is not loaded do not count"


def test_the_default_preset_loads_its_backends_and_no_others():
    found = count.probe(count.HERE)
    names = {Path(file).relative_to(count.HERE / "hat_ros").as_posix() for file in found["files"]}
    assert {"tracker.py", "segmentation/classical.py", "hypotheses/template.py", "motion/feature.py"} <= names
    assert not any(name.startswith(("nets/", "bench/", "ros/")) for name in names)
    assert found["keys"].count("expert") > 0
