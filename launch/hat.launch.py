"""The graph on a system with ROS 2 Jazzy installed: ``ros2 launch hat_ros hat.launch.py target:=cad.glb``.

Every node configures and activates itself (``autostart``), so no lifecycle manager is needed. A node that dies is
started again; with ``live:=true`` the graph then goes on in a new epoch.

Unless the environment says otherwise (``FASTRTPS_DEFAULT_PROFILES_FILE``, ``ROS_AUTOMATIC_DISCOVERY_RANGE``) each node
takes the Fast DDS profile that comes with the package and discovers other nodes on this machine only.
"""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.launch_description import LaunchDescription
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

STAGES = ("segmentation", "hypotheses", "slam", "selector", "fusion")

# Name, default (None: must be given), description.
ARGUMENTS = (
    ("config", "default", "preset or YAML file"),
    ("target", None, "CAD model (obj, ply, stl, glb) or target.yaml"),
    ("live", "true", "one frame in flight, the newest wins; false: nothing may be dropped"),
    ("image", "/image", "topic of the image; compressed images on <image>/compressed"),
    ("camera_info", "/camera_info", "topic of its calibration"),
    (
        "rectified",
        "auto",
        "which image it describes: true (P), false (K, D is undone), auto: by the image topic's name",
    ),
    ("image_depth", "auto", "significant bits of 16-bit images, 8 to 16"),
    ("overlay", "true", "offer /hat/overlay/compressed"),
)


def generate_launch_description() -> LaunchDescription:
    arguments = [DeclareLaunchArgument(name, default_value=value, description=doc) for name, value, doc in ARGUMENTS]
    values = {name: LaunchConfiguration(name) for name in ("config", "target", "live")}
    values |= {f"camera.{name}": LaunchConfiguration(name) for name in ("rectified", "image_depth")}
    parameters = [values]
    image = LaunchConfiguration("image")
    remappings = [
        ("/image", image),
        ("/image/compressed", [image, "/compressed"]),
        ("/camera_info", LaunchConfiguration("camera_info")),
    ]
    stages = [
        Node(
            package="hat_ros",
            executable=f"{name}_node",
            name=name,
            namespace="hat",
            parameters=parameters,
            remappings=remappings,
            output="screen",
            respawn=True,
            respawn_delay=2.0,
        )
        for name in STAGES
    ]
    overlay = Node(
        package="hat_ros",
        executable="overlay_node",
        name="overlay",
        namespace="hat",
        parameters=parameters,
        condition=IfCondition(LaunchConfiguration("overlay")),
    )
    return LaunchDescription([*arguments, *stages, overlay])
