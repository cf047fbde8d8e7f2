"""Start the depth node for a left and a right camera."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return the node with its topics; ``left``, ``right`` and ``image`` are launch arguments."""
    parameters = str(Path(get_package_share_directory("geodiff_ros")) / "config" / "depth.yaml")
    left, right, image = (LaunchConfiguration(name) for name in ("left", "right", "image"))
    return LaunchDescription(
        [
            DeclareLaunchArgument("left", default_value="left", description="namespace of the left camera"),
            DeclareLaunchArgument(
                "right", default_value="right", description="namespace of the right camera"
            ),
            DeclareLaunchArgument(
                "image", default_value="image_rect", description="name of the image topics"
            ),
            Node(
                package="geodiff_ros",
                executable="depth_node",
                name="geodiff_depth",
                parameters=[parameters],
                remappings=[
                    ("left/image", [left, "/", image]),
                    ("right/image", [right, "/", image]),
                    ("left/camera_info", [left, "/camera_info"]),
                    ("right/camera_info", [right, "/camera_info"]),
                ],
            ),
        ]
    )
