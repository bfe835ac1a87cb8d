"""ROS parameters of every node: the whole configuration by dotted name, and how the node runs.

``config`` names a preset or file, any other parameter overrides it, and a name that does not exist is refused with
the nearest one (ROS itself would ignore it). Parameters are read-only: a node is configured once.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from hat_ros.config import HatConfig, config_from_dict, config_to_dict, describe, flat_options, load_config
from hat_ros.errors import ConfigError
from hat_ros.io import topics

if TYPE_CHECKING:
    from hat_ros.target.model import Target

_RUN_OPTIONS: dict[str, tuple[Any, str]] = {
    "config": ("default", "preset (default, mega_hat, ...) or YAML file; other parameters override it"),
    "target": ("", "CAD model (obj, ply, stl, glb) or target.yaml"),
    "target_frame_id": ("", "name of the target (CAD) frame, empty = the model's name"),
    "publish_tf": (True, "publish the target's pose on /tf, too, where tf2_msgs is present"),
    "live": (False, "a camera that cannot wait: few frames in flight, the newest wins, drops are counted"),
    "autostart": (True, "configure and activate by itself, without a lifecycle manager"),
    "exit_at_end": (False, "end the process after /hat/end_of_stream"),
    "recorded": (False, "wait for the recorder before reporting ready"),
    "supervisor_pid": (0, "end the process when its parent is no longer this one, 0 = never"),
}
# Parameters that ROS itself knows.
_ROS_OWN = ("use_sim_time", "start_type_description_service")


@dataclass(frozen=True)
class Settings:
    """The values of a node's parameters.

    Attributes:
        config: the configuration of all stages.
        config_name: the preset or file that it started from.
        target: path of the CAD model or ``target.yaml``.
        target_frame_id: name of the target frame, empty = the model's name.
        publish_tf: the pose goes out on ``/tf``, too.
        live: the source cannot wait.
        autostart: configure and activate without a manager.
        exit_at_end: the process ends after the end of the stream.
        recorded: a recorder must be matched before the node is ready.
        supervisor_pid: parent process whose end ends this one, 0 = none.
        extra: values of the options that only this node has.
    """

    config: HatConfig
    config_name: str
    target: str
    target_frame_id: str
    publish_tf: bool
    live: bool
    autostart: bool
    exit_at_end: bool
    recorded: bool
    supervisor_pid: int
    extra: dict[str, Any]

    def load_target(self) -> Target:
        """Read the CAD model that the parameter ``target`` names.

        Raises:
            ConfigError: the parameter is empty.
            MeshError: the model is unusable.
        """
        from hat_ros.target.loading import load_target  # seconds of imports that not every node needs

        if not self.target:
            raise ConfigError("parameter 'target' is empty: give the CAD model or target.yaml, -p target:=FILE")
        return load_target(self.target)


def declare_parameters(node: Node, extra: dict[str, tuple[Any, str]] | None = None) -> Settings:
    """Declare every parameter of a node and return their values.

    Args:
        node: created with ``automatically_declare_parameters_from_overrides=True``.
        extra: name -> (default, description) of options that only this node has.

    Raises:
        ConfigError: an unknown name, a wrong type, a value out of range, or an unknown preset or file.
    """
    run_options = {**_RUN_OPTIONS, **(extra or {})}
    given = _take_overrides(node)
    names = [*run_options, *flat_options()]
    for name in given:
        if name not in names:
            close = difflib.get_close_matches(name, names, n=1)
            advice = f"did you mean '{close[0]}'?" if close else "see `ros2 param list` for the known ones"
            raise ConfigError(f"node {node.get_name().removeprefix('hat_')}: unknown parameter '{name}': {advice}")
    run = {name: _checked(name, given.get(name, default), default) for name, (default, _) in run_options.items()}
    config = _configure(run["config"], {name: given[name] for name in given if name not in run_options})
    if run["live"] and config.initial_pose.pose:
        where = topics.relative(topics.INITIAL_POSE)
        raise ConfigError(
            f"initial_pose.pose: it belongs to the first frame of a recording; live, send the pose on the topic {where}"
        )
    for name, (_, doc) in run_options.items():
        node.declare_parameter(name, run[name], ParameterDescriptor(description=doc, read_only=True), True)
    for name, (value, field) in flat_options(config).items():
        node.declare_parameter(name, value, _descriptor(field.metadata, value), True)
    common = {name: run[name] for name in _RUN_OPTIONS if name != "config"}
    return Settings(config=config, config_name=run["config"], **common, extra={name: run[name] for name in extra or {}})


def _take_overrides(node: Node) -> dict[str, Any]:
    """Values given on the command line or in a parameter file; undeclared again, to be declared with descriptions."""
    own = [name for name in node.list_parameters([], 0).names if not _is_ros_own(name)]
    given = {name: node.get_parameter(name).value for name in own}
    for name in own:
        node.undeclare_parameter(name)
    return given


def _is_ros_own(name: str) -> bool:
    return name in _ROS_OWN or name.startswith("qos_overrides.")


def _checked(name: str, value: Any, default: Any) -> Any:
    if isinstance(default, list):
        if not isinstance(value, Sequence) or isinstance(value, str) or not all(isinstance(v, str) for v in value):
            raise ConfigError(f"{name}: expected a list of strings, found {value!r}")
        return list(value)
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not type(default):
        raise ConfigError(f"{name}: expected {type(default).__name__}, found {value!r} ({type(value).__name__})")
    return value


def _configure(name_or_file: str, overrides: dict[str, Any]) -> HatConfig:
    data = config_to_dict(load_config(name_or_file))
    for name, value in overrides.items():
        *sections, last = name.split(".")
        node = data
        for section in sections:
            node = node[section]
        node[last] = value
    return config_from_dict(data)


def _descriptor(metadata: Any, value: Any) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=describe(metadata), read_only=True, dynamic_typing=value is None)
    low, high = metadata.get("low"), metadata.get("high")
    if metadata.get("choices"):
        descriptor.additional_constraints = f"one of {', '.join(metadata['choices'])}"
    if low is None and high is None:
        return descriptor
    if isinstance(value, float):
        limit = sys.float_info.max
        low, high = -limit if low is None else float(low), limit if high is None else float(high)
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    elif isinstance(value, int) and not isinstance(value, bool):
        low, high = -(2**63) if low is None else int(low), 2**63 - 1 if high is None else int(high)
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=0)]
    return descriptor
