"""One run of a ROS 2 system: starts its launch file, plays the recording, records poses, writes ``traj.txt``."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.errors import InvalidInput, SlamHiveError
from slamhive.files import write_aside
from slamhive.runtime.config import RunConfig, load
from slamhive.runtime.paths import find_recording, run_paths
from slamhive.runtime.trajectory import Poses, transform_from, write_trajectory

POSE_TOPIC = "/odom"
"""Change it to the topic on which your system publishes ``nav_msgs/Odometry``."""
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


def poses_of(messages: Sequence[Any]) -> Poses:
    """One pose for each ``nav_msgs/Odometry``; the last where several have the same timestamp."""
    found = {}
    for message in messages:
        stamp, pose = message.header.stamp, message.pose.pose
        at, turned = pose.position, pose.orientation
        T = transform_from(np.array([at.x, at.y, at.z]), np.array([turned.x, turned.y, turned.z, turned.w]))
        found[stamp.sec + stamp.nanosec * 1e-9] = T
    return Poses(np.array(sorted(found)), np.array([found[key] for key in sorted(found)]).reshape(-1, 4, 4))


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
    from nav_msgs.msg import Odometry  # noqa: PLC0415

    paths = run_paths()
    config, recording = load(paths.config), find_recording(paths.dataset)
    check_config(config, recording)
    rclpy.init()
    node = rclpy.create_node("slamhive")
    messages: list[Any] = []
    node.create_subscription(Odometry, POSE_TOPIC, messages.append, 1000)
    nodes = subprocess.Popen(launch_command(config, Path(__file__).parent))
    try:
        _wait_for_listeners(node, list(config.algorithm_remap.values()), nodes)
        player = subprocess.Popen(play_command(config, recording))
        while player.poll() is None:
            rclpy.spin_once(node, timeout_sec=0.05)
            _check_running(nodes)
        if player.returncode != 0:
            raise SlamHiveError(f"ros2 bag play ended with exit code {player.returncode}")
        until_s, seen = time.monotonic() + QUIET_S, len(messages)
        while time.monotonic() < until_s:
            rclpy.spin_once(node, timeout_sec=0.05)
            if len(messages) > seen:
                until_s, seen = time.monotonic() + QUIET_S, len(messages)
    finally:
        nodes.send_signal(signal.SIGINT)
        nodes.wait(20)
    write_trajectory(paths.result / "traj.txt", poses_of(messages))
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
