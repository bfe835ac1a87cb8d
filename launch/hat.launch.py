"""The graph on a system with ROS 2 Jazzy installed: ``ros2 launch hat_ros hat.launch.py target:=cad.glb``.

Every node configures and activates itself (``autostart``), so no lifecycle manager is needed. A node that dies is
started again at once, and with ``live:=true`` the graph then goes on in a new epoch. One that was given bad input says
so and ends with exit code 2; started again it would say the same, so it is not.

Two cameras: one launch each, with a ``namespace`` of its own. All topics but ``/tf`` and ``/diagnostics`` lie there.

Each node takes the package's Fast DDS profile, unless ``FASTRTPS_DEFAULT_PROFILES_FILE`` names another.
"""

from __future__ import annotations

import os
from functools import partial
from typing import Any

from launch.actions import DeclareLaunchArgument, RegisterEventHandler
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.launch_description import LaunchDescription
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

STAGES = ("segmentation", "hypotheses", "slam", "selector", "fusion")

# Exit codes of a node that has nothing more to do: it has finished, or its input is bad.
DONE = 0
BAD_INPUT = 2

# A node stops at SIGINT. One that is in the middle of something long gets SIGTERM, then SIGKILL: two seconds in all.
SIGTERM_S = "1.0"
SIGKILL_S = "0.8"

# Name, default (None: must be given), description.
ARGUMENTS = (
    ("config", "default", "preset or YAML file"),
    ("target", None, "CAD model (obj, ply, stl, glb) or target.yaml"),
    ("live", "true", "the newest frame wins; false: nothing may be dropped"),
    ("namespace", "", "of all nodes and their topics, for example cam1"),
    ("image", "image", "topic of the image; compressed images on <image>/compressed"),
    ("camera_info", "camera_info", "topic of its calibration"),
    ("transport", "auto", "raw, compressed, or auto: what the camera publishes, raw if both"),
    (
        "rectified",
        "auto",
        "which image it describes: true (P), false (K, D is undone), auto: by the image topic's name",
    ),
    ("image_depth", "auto", "significant bits of 16-bit images, 8 to 16"),
    ("target_frame_id", "", "name of the target (CAD) frame, empty: the model's name"),
    ("publish_tf", "true", "publish the pose on /tf, too"),
    ("credits_live", "1", "frames in flight: 2 give more poses per second, each later"),
    ("use_sim_time", "false", "diagnostics carry the time of /clock"),
    ("overlay", "true", "offer hat/overlay/compressed"),
)

# Parameters that have the name of their argument, and those that belong to a section of the configuration.
STRINGS = ("config", "target", "target_frame_id", "camera.transport", "camera.rectified", "camera.image_depth")
OTHERS = {"live": bool, "publish_tf": bool, "use_sim_time": bool, "graph.credits_live": int}


def generate_launch_description() -> LaunchDescription:
    arguments = [DeclareLaunchArgument(name, default_value=value, description=doc) for name, value, doc in ARGUMENTS]
    nodes = [action for name in STAGES for action in _started(name)]
    return LaunchDescription([*arguments, *nodes, *_started("overlay", IfCondition(LaunchConfiguration("overlay")))])


def _started(name: str, condition: Any = None) -> list[Any]:
    """A node, and what happens when it ends."""
    image = LaunchConfiguration("image")
    kinds = dict.fromkeys(STRINGS, str) | OTHERS
    # The type is said: `rectified:=true` and `image_depth:=12` are strings.
    values = {
        key: ParameterValue(LaunchConfiguration(key.split(".")[-1]), value_type=kind) for key, kind in kinds.items()
    }
    node = Node(
        package="hat_ros",
        executable=f"{name}_node",
        name=f"hat_{name}",
        namespace=LaunchConfiguration("namespace"),
        # SIGTERM of `ros2 launch` ends it alone, without a word to its nodes: they look after it themselves.
        parameters=[{**values, "supervisor_pid": os.getpid()}],
        remappings=[
            ("image", image),
            ("image/compressed", [image, "/compressed"]),
            ("camera_info", LaunchConfiguration("camera_info")),
        ],
        output="screen",
        condition=condition,
        sigterm_timeout=SIGTERM_S,
        sigkill_timeout=SIGKILL_S,
    )
    again = OnProcessExit(target_action=node, on_exit=partial(_ended, name, condition))
    return [RegisterEventHandler(again, condition=condition), node]


def _ended(name: str, condition: Any, event: Any, context: Any) -> list[Any] | None:
    """What follows the end of a node."""
    if context.is_shutdown or event.returncode in (DONE, BAD_INPUT):
        return None
    return _started(name, condition)
