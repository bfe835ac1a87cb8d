"""What the sources promise: where rclpy is imported, and that no node knows the ground truth."""

from __future__ import annotations

import ast
from pathlib import Path

import hat_ros

PACKAGE = Path(hat_ros.__file__).parent


def sources():
    return [(path, ast.parse(path.read_text(encoding="utf-8"))) for path in PACKAGE.rglob("*.py")]


def imported(tree):
    for item in ast.walk(tree):
        if isinstance(item, ast.Import):
            yield from (alias.name for alias in item.names)
        elif isinstance(item, ast.ImportFrom) and item.module:
            yield item.module


def test_only_the_nodes_import_rclpy():
    for path, tree in sources():
        if path.parent.name != "ros":
            assert not any(name.split(".")[0] == "rclpy" for name in imported(tree)), path


def test_no_node_ever_names_the_truth():
    naming = {path.name for path, _ in sources() if "GROUND_TRUTH" in path.read_text() and path.parent.name == "ros"}
    assert naming == {"replay_run.py"}, "it is copied from bag to record there; no node subscribes or publishes"


def test_nodes_are_thin():
    for path in sorted((PACKAGE / "ros").glob("*_node.py")):
        assert len(path.read_text(encoding="utf-8").splitlines()) < 100, path


def test_no_call_logs_with_two_severities():
    """rclpy ties a severity to the place of a call: the second one raises ValueError there, minutes later."""
    levels = {"debug", "info", "warning", "error", "fatal"}
    for path, tree in sources():
        for item in ast.walk(tree):
            if isinstance(item, ast.IfExp):
                chosen = {part.attr for part in (item.body, item.orelse) if isinstance(part, ast.Attribute)}
                assert not chosen & levels, f"{path}:{item.lineno}"
