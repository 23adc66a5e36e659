"""Starts steadypose: ros2 launch steadypose_ros steadypose.launch.py launch:=oak.toml namespace:=robot"""

# pyright: reportMissingImports=false
# these packages are installed with ROS

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    "launch": ("ros2", "a launch file of steadypose whose nodes include ros2_bridge, or the name of a bundled one"),
    "command": ("steadypose", "the steadypose program; its path, if it is not on PATH"),
    "namespace": ("", "namespace of the node and its topics, except /tf, /tf_static, /clock and /diagnostics"),
    "params_file": (
        str(Path(__file__).parents[1] / "config/steadypose.yaml"),
        "parameters: any setting of the launch file",
    ),
}


def generate_launch_description() -> LaunchDescription:
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    node = Node(
        package="steadypose_ros",
        executable="steadypose",
        name="steadypose",
        namespace=given["namespace"],
        parameters=[{name: given[name] for name in ("launch", "command")}, given["params_file"]],
        output="screen",
        sigterm_timeout="20",  # time for the program to complete its recording
    )
    arguments = [
        DeclareLaunchArgument(name, default_value=it, description=what) for name, (it, what) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, node])
