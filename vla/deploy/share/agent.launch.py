"""ros2 launch vla agent.launch.py checkpoint:=RUN network:=site"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode


def generate_launch_description() -> LaunchDescription:
    """Launch the policy node, which configures and activates itself."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("checkpoint", description="a trained policy"),
            DeclareLaunchArgument("network", default_value="loopback", description="loopback, localhost or site"),
            LifecycleNode(
                package="vla",
                executable="agent",
                name="vla_agent",
                namespace="",
                output="screen",
                arguments=[
                    ["checkpoint=", LaunchConfiguration("checkpoint")],
                    ["deploy.network.reach=", LaunchConfiguration("network")],
                ],
            ),
        ]
    )
