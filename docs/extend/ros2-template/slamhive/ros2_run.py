"""One run of a ROS 2 system: starts its launch file, plays the recording, records poses, writes ``traj.txt``."""

from __future__ import annotations

import importlib
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.base.files import write_aside
from slamhive.runtime.config import RunConfig, load
from slamhive.runtime.paths import find_recording, run_paths
from slamhive.runtime.ros_poses import PoseKind, PoseLog, PoseTopic
from slamhive.runtime.trajectory import write_trajectory

POSES = PoseTopic("/odom", PoseKind.ODOMETRY)
"""Where poses come from. Change it to the topic of your system; PoseKind has the types that can be read.

For TF: ``PoseTopic("/tf", PoseKind.TF, parent="map", child="imu")``.
"""
START_PATIENCE_S = 60.0
QUIET_S = 2.0


def launch_command(config: RunConfig, folder: Path) -> list[str]:
    """``ros2 launch`` with an argument for each role and each parameter."""
    arguments = {**config.algorithm_remap, **config.algorithm_parameters}
    return [
        "ros2",
        "launch",
        str(folder / "my_slam.launch.py"),
        *(f"{key}:={value}" for key, value in arguments.items()),
    ]


def play_command(config: RunConfig, recording: Path) -> list[str]:
    """``ros2 bag play`` with the remaps of the run, in real time."""
    topics = [config.topic_in_bag(role) for role in config.algorithm_remap]
    remaps = [f"{recorded}:={seen}" for seen, recorded in config.dataset_remap.items() if seen != recorded]
    command = ["ros2", "bag", "play", str(recording), "--clock", "--rate", f"{config.playback_rate:g}"]
    return [*command, "--topics", *topics, *(["--remap", *remaps] if remaps else [])]


def message_type(kind: PoseKind) -> Any:
    """The class of the messages: ``nav_msgs/Odometry`` is that of ``nav_msgs.msg``."""
    package, _, name = kind.partition("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def check_config(config: RunConfig, recording: Path) -> None:
    """Raise InvalidInput for what ``ros2 bag play`` cannot play."""
    if config.playback_mode != "realtime":
        raise InvalidInput(f"{config.algorithm} cannot be played {config.playback_mode}", "play it realtime")
    if recording.suffix == ".bag":
        remedy = f"slamhive dataset export {config.dataset} --format ros2"
        raise InvalidInput(f"{recording.name} is a ROS 1 bag, {config.algorithm} plays ROS 2", remedy)


def run() -> None:
    """The whole run; raises SlamHiveError with the reason if a program ends early."""
    import rclpy  # noqa: PLC0415 - only images of ROS 2 have it

    paths = run_paths()
    config, recording = load(paths.config), find_recording(paths.dataset)
    check_config(config, recording)
    rclpy.init()
    node = rclpy.create_node("slamhive")
    found = PoseLog(POSES)
    node.create_subscription(
        message_type(POSES.kind), POSES.topic, lambda message: found.add(message, time.monotonic()), 1000
    )
    nodes = subprocess.Popen(launch_command(config, Path(__file__).parent))
    try:
        _wait_for_listeners(node, list(config.algorithm_remap.values()), nodes)
        player = subprocess.Popen(play_command(config, recording))
        while player.poll() is None:
            rclpy.spin_once(node, timeout_sec=0.05)
            _check_running(nodes)
        if player.returncode != 0:
            raise SlamHiveError(f"ros2 bag play ended with exit code {player.returncode}")
        until_s, seen = time.monotonic() + QUIET_S, len(found.arrivals)
        while time.monotonic() < until_s:
            rclpy.spin_once(node, timeout_sec=0.05)
            if len(found.arrivals) > seen:
                until_s, seen = time.monotonic() + QUIET_S, len(found.arrivals)
    finally:
        nodes.send_signal(signal.SIGINT)
        nodes.wait(20)
    write_trajectory(paths.result / "traj.txt", found.poses)
    write_aside(paths.result / "finished", "")


def _wait_for_listeners(node: Any, topics: Sequence[str], nodes: subprocess.Popen[bytes]) -> None:
    until_s = time.monotonic() + START_PATIENCE_S
    while missing := [topic for topic in topics if not node.count_subscribers(topic)]:
        _check_running(nodes)
        if time.monotonic() > until_s:
            raise SlamHiveError(f"after {START_PATIENCE_S:g} s nobody listens to {missing[0]}")
        time.sleep(0.1)


def _check_running(nodes: subprocess.Popen[bytes]) -> None:
    if nodes.poll() is not None:
        raise SlamHiveError(f"ros2 launch ended with exit code {nodes.returncode}")


if __name__ == "__main__":
    try:
        run()
    except SlamHiveError as error:
        sys.exit(f"error: {error}")
