"""The node: `ros2 launch skin_host_ros skin.launch.py broker:=mqtt://robot.local`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Declare the broker and the robot, and start the node with them."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("broker", default_value="mqtt://localhost"),
            DeclareLaunchArgument("robot", default_value=""),
            Node(
                package="skin_host_ros",
                executable="skin",
                name="skin",
                respawn=True,  # it ends where no broker or no robot is found
                respawn_delay=2.0,
                parameters=[
                    {"broker": LaunchConfiguration("broker"), "robot": LaunchConfiguration("robot")}
                ],
            ),
        ]
    )
