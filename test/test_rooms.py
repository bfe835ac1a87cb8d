"""The rooms of the package: imports go one way, and what is flown never imports the laboratory."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import hat_ros

PACKAGE = Path(hat_ros.__file__).parent

# Each room may import itself and the rooms before it.
FLOORS = (
    ("errors", "array_types"),
    ("geometry", "cache", "spans"),
    ("types",),
    ("config",),
    ("target", "core"),
    ("nets", "stages"),
    ("refinement", "segmentation", "motion"),
    ("hypotheses",),
    ("tracking",),
    ("tracker",),
    ("io",),
    ("app",),
    ("ros",),
    ("bench",),
    ("cli",),
)
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}

# The same within the laboratory.
BENCH_FLOORS = (
    ("datasets",),
    ("synth", "source", "observations"),
    ("evaluation", "check_frames"),
    ("live",),
    ("check", "check_picture"),
    ("methods",),
    ("runs",),
    ("experiments",),
    ("campaign", "training"),
)
BENCH_FLOOR = {room: number for number, rooms in enumerate(BENCH_FLOORS) for room in rooms}


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path: Path):
    """Modules of the package that a file imports, anywhere in it; type checking counts too."""
    for item in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(item, ast.ImportFrom) and item.module and item.module.startswith("hat_ros."):
            yield item.module
        elif isinstance(item, ast.ImportFrom) and item.module == "hat_ros":
            yield from (f"hat_ros.{alias.name}" for alias in item.names if (PACKAGE / alias.name).exists())
        elif isinstance(item, ast.Import):
            yield from (alias.name for alias in item.names if alias.name.startswith("hat_ros."))


SOURCES = [path for path in sorted(PACKAGE.rglob("*.py")) if path.name != "__init__.py" or path.parent != PACKAGE]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    room = room_of(path)
    assert room in FLOOR, f"a new room: where does it stand? {room}"
    for module in imports(path):
        other = module.split(".")[1]
        below = other == room or FLOOR[other] < FLOOR[room]
        assert below, f"{path.relative_to(PACKAGE)} imports {module}, which stands above or beside it"


BENCH_SOURCES = [path for path in SOURCES if room_of(path) == "bench" and path.parent.parent != PACKAGE]
BENCH_SOURCES += [path for path in (PACKAGE / "bench").glob("*.py") if path.name != "__init__.py"]


@pytest.mark.parametrize("path", BENCH_SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_one_way_within_the_laboratory(path):
    room = path.relative_to(PACKAGE).parts[1].removesuffix(".py")
    for module in imports(path):
        if module.startswith("hat_ros.bench."):
            other = module.split(".")[2]
            below = other == room or BENCH_FLOOR[other] < BENCH_FLOOR[room]
            assert below, f"{path.relative_to(PACKAGE)} imports {module}, which stands above or beside it"


def test_what_is_flown_loads_no_laboratory():
    code = "import sys, hat_ros.tracker, hat_ros.app.pipeline, hat_ros.ros.single; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not [name for name in done.stdout.split() if name.startswith("hat_ros.bench")]
