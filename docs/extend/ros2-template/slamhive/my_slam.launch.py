"""Starts the nodes of the system: an argument for each role, the topic to listen to."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, Shutdown
from launch.substitutions import LaunchConfiguration


def generate_launch_description() -> LaunchDescription:
    """Replace the process by your nodes; the run ends when it does."""
    node = ExecuteProcess(
        cmd=[
            "python3",
            "/slamhive/gyroscope.py",
            "--ros-args",
            "--param",
            "use_sim_time:=true",
            "--remap",
            ["points:=", LaunchConfiguration("points")],
            "--remap",
            ["imu:=", LaunchConfiguration("imu")],
        ],
        output="screen",
        on_exit=Shutdown(),
    )
    arguments = [DeclareLaunchArgument(name) for name in ("points", "imu")]
    return LaunchDescription([*arguments, node])
