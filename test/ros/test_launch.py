"""The launch file, run with stand-ins for ``launch`` and ``launch_ros``, which have no wheels."""

from __future__ import annotations

import os
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

import hat_ros
from hat_ros.config import flat_options
from hat_ros.errors import InputError
from hat_ros.ros.params import _RUN_OPTIONS

LAUNCH_FILE = Path(__file__).parents[2] / "launch" / "hat.launch.py"
NODES = Path(hat_ros.__file__).parent / "ros"


class Action:
    """Remembers how it was made."""

    def __init__(self, *args, **options):
        self.args, self.options = args, options


@pytest.fixture
def launch_file(monkeypatch):
    made = {
        "launch": (),
        "launch.launch_description": ("LaunchDescription",),
        "launch.actions": ("DeclareLaunchArgument", "RegisterEventHandler"),
        "launch.conditions": ("IfCondition",),
        "launch.event_handlers": ("OnProcessExit",),
        "launch.substitutions": ("LaunchConfiguration",),
        "launch_ros": (),
        "launch_ros.actions": ("Node",),
        "launch_ros.parameter_descriptions": ("ParameterValue",),
    }
    for name, classes in made.items():
        module = ModuleType(name)
        for class_name in classes:
            setattr(module, class_name, type(class_name, (Action,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    return runpy.run_path(str(LAUNCH_FILE))


@pytest.fixture
def described(launch_file):
    (actions,) = launch_file["generate_launch_description"]().args
    return actions


def of_class(actions, name):
    return [action for action in actions if type(action).__name__ == name]


def test_every_node_that_is_started_exists(described):
    names = [node.options["name"] for node in of_class(described, "Node")]
    assert names == [f"hat_{name}" for name in ("segmentation", "hypotheses", "slam", "selector", "fusion", "overlay")]
    for node in of_class(described, "Node"):
        assert node.options["executable"] == f"{node.options['name'].removeprefix('hat_')}_node"
        assert (NODES / f"{node.options['executable']}.py").is_file()


def test_every_argument_is_used_and_every_parameter_exists_with_its_type(described):
    declared = {argument.args[0] for argument in of_class(described, "DeclareLaunchArgument")}
    kinds = {name: type(default) for name, (default, _) in _RUN_OPTIONS.items()}
    kinds |= {name: type(value) for name, (value, _) in flat_options().items()} | {"use_sim_time": bool}
    used = {"overlay"}
    for node in of_class(described, "Node"):
        (parameters,) = node.options["parameters"]
        assert parameters.pop("supervisor_pid") == os.getpid(), "a launch that is killed leaves no nodes"
        assert {name: value.options["value_type"] for name, value in parameters.items()} == {
            name: kinds[name] for name in parameters
        }
        used |= {value.args[0].args[0] for value in parameters.values()} | {node.options["namespace"].args[0]}
    for _, target in of_class(described, "Node")[0].options["remappings"]:
        parts = target if isinstance(target, list) else [target]
        used |= {part.args[0] for part in parts if isinstance(part, Action)}
    assert used == declared


def test_only_the_target_must_be_given(described):
    defaults = {
        action.args[0]: action.options["default_value"] for action in of_class(described, "DeclareLaunchArgument")
    }
    assert [name for name, value in defaults.items() if value is None] == ["target"]


def test_what_died_starts_again_but_not_what_has_finished_or_was_given_bad_input(described):
    watches = [action.args[0] for action in of_class(described, "RegisterEventHandler")]
    nodes = of_class(described, "Node")
    assert [watch.options["target_action"] for watch in watches] == nodes
    running, stopping = SimpleNamespace(is_shutdown=False), SimpleNamespace(is_shutdown=True)
    for watch, node in zip(watches, nodes, strict=True):
        ended = watch.options["on_exit"]
        for code in (0, InputError.exit_code):
            assert ended(SimpleNamespace(returncode=code), running) is None
        for code in (1, -9, -11):
            assert ended(SimpleNamespace(returncode=code), stopping) is None
            (again,) = of_class(ended(SimpleNamespace(returncode=code), running), "Node")
            assert again is not node
            assert again.options["name"] == node.options["name"]
    assert "respawn" not in nodes[0].options


def test_a_launch_that_is_stopped_ends_its_nodes_within_two_seconds(described):
    for node in of_class(described, "Node"):
        assert float(node.options["sigterm_timeout"]) + float(node.options["sigkill_timeout"]) < 2
