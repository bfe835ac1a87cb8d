"""The launch file, run with stand-ins for ``launch`` and ``launch_ros``, which have no wheels."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType

import pytest

import hat_ros
from hat_ros.config import flat_options
from hat_ros.ros.params import _RUN_OPTIONS

LAUNCH_FILE = Path(__file__).parents[2] / "launch" / "hat.launch.py"
NODES = Path(hat_ros.__file__).parent / "ros"


class Action:
    """Remembers how it was made."""

    def __init__(self, *args, **options):
        self.args, self.options = args, options


@pytest.fixture
def described(monkeypatch):
    made = {
        "launch": (),
        "launch.launch_description": ("LaunchDescription",),
        "launch.actions": ("DeclareLaunchArgument",),
        "launch.conditions": ("IfCondition",),
        "launch.substitutions": ("LaunchConfiguration",),
        "launch_ros": (),
        "launch_ros.actions": ("Node",),
    }
    for name, classes in made.items():
        module = ModuleType(name)
        for class_name in classes:
            setattr(module, class_name, type(class_name, (Action,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    (actions,) = runpy.run_path(str(LAUNCH_FILE))["generate_launch_description"]().args
    return actions


def of_class(actions, name):
    return [action for action in actions if type(action).__name__ == name]


def test_every_node_that_is_started_exists(described):
    names = [node.options["name"] for node in of_class(described, "Node")]
    assert names == ["segmentation", "hypotheses", "slam", "selector", "fusion", "overlay"]
    for node in of_class(described, "Node"):
        assert node.options["executable"] == f"{node.options['name']}_node"
        assert (NODES / f"{node.options['executable']}.py").is_file()


def test_every_argument_is_used_and_every_parameter_exists(described):
    declared = {argument.args[0] for argument in of_class(described, "DeclareLaunchArgument")}
    used = {"overlay"}
    for node in of_class(described, "Node"):
        (parameters,) = node.options["parameters"]
        assert set(parameters) <= {*_RUN_OPTIONS, *flat_options()}
        used |= {value.args[0] for value in parameters.values()}
    for _, target in of_class(described, "Node")[0].options["remappings"]:
        parts = target if isinstance(target, list) else [target]
        used |= {part.args[0] for part in parts if isinstance(part, Action)}
    assert used == declared


def test_only_the_target_must_be_given(described):
    defaults = {
        action.args[0]: action.options["default_value"] for action in of_class(described, "DeclareLaunchArgument")
    }
    assert [name for name, value in defaults.items() if value is None] == ["target"]
