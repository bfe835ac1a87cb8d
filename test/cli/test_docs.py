"""Commands in README and docs are commands of ours: names, options and choices as they stand there."""

import re
import shlex
from pathlib import Path

import pytest

from hat_ros.bench.experiments.comparison import Entry
from hat_ros.cli import build_parser

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", "CONTRIBUTING.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md"))))


def commands(page: str) -> list[str]:
    """Every `hat ...` in code, comments and `.venv/bin/` left out."""
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    lines += re.findall(r"`((?:\.venv/bin/)?hat [^`]+)`", text.replace("\n", " "))
    lines = [line.removeprefix(".venv/bin/") for line in lines]
    return [
        line
        for line in lines
        if line.startswith("hat ") and not {"...", "--help", "needs"} & {*line.split()} and len(line.split()) > 2
    ]


@pytest.mark.parametrize(("page", "command"), [(page, command) for page in PAGES for command in commands(page)])
def test_command_parses(page, command):
    words = [word for word in shlex.split(command, comments=True)[1:] if word != "METHODS"]
    parsed = build_parser().parse_args(words)
    for text in getattr(parsed, "methods", []):
        Entry.parse(text, "default")


def test_methods_of_the_papers_table_parse():
    text = (ROOT / "docs" / "benchmark.md").read_text(encoding="utf-8")
    words = shlex.split(re.search(r"```sh\n(--method.*?)```", text, re.DOTALL).group(1))
    parsed = build_parser().parse_args(["bench", "--suite", "suite", "--out", "out", *words])
    names = [Entry.parse(method, "default").name for method in parsed.methods] + [name for name, _ in parsed.poses]
    assert names == ["MegaPose", "PicoPose", "GigaPose", "SRT3D", "Mega-HAT", "Pico-HAT", "RGBTrack"]
